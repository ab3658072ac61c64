"""What the code never does: run text, start shells, load pickles from files, listen to the network unasked."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import PROJECT

SOURCES = sorted(
    path for folder in ("pipeline", "render", "sim", "blender_scripts") for path in (PROJECT / folder).rglob("*.py")
)
FORBIDDEN_CALLS = {
    *("eval", "exec", "compile", "os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"),
    *(f"os.{kind}{how}" for kind in ("exec", "spawn") for how in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
    *("yaml.load", "marshal.loads", "marshal.load", "shelve.open", "numpy.load", "np.load", "runpy.run_path"),
}
STARTERS = {f"subprocess.{name}" for name in ("Popen", "run", "call", "check_call", "check_output")}
EVERY_ADDRESS = {"0.0.0.0", "::"}


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PROJECT).as_posix())
def test_no_text_is_run_and_no_shell_is_started(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for name, call in calls(tree):
        assert name not in FORBIDDEN_CALLS, f"{path}:{call.lineno}: {name}"
        shell = next((each.value for each in call.keywords if each.arg == "shell"), None)
        assert shell is None, f"{path}:{call.lineno}: shell="
        if name in STARTERS:
            command = [*call.args[:1], *(each.value for each in call.keywords if each.arg == "args")][0]
            assert not isinstance(command, ast.Constant | ast.JoinedStr), f"{path}:{call.lineno}: no list"
    constants = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert not EVERY_ADDRESS & {each for each in constants if isinstance(each, str)}


def test_pickles_travel_between_a_runner_and_its_own_workers_only() -> None:
    using = {
        path.relative_to(PROJECT).as_posix()
        for path in SOURCES
        if any(
            (isinstance(node, ast.Import | ast.ImportFrom) and any("pickle" in alias.name for alias in node.names))
            or (isinstance(node, ast.ImportFrom) and "pickle" in (node.module or ""))
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        )
    }
    assert using <= {
        "pipeline/run/executors/channel.py",
        "pipeline/run/executors/dask_connection.py",
        "pipeline/run/executors/dask_driver.py",
    }
