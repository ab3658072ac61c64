"""The house's rules that no other test would notice: who imports whom, and what is loaded when."""

import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest
from places import PROJECT

import pipeline

HEAVY = {"taichi", "bpy", "trimesh", "igl", "scipy", "av", "pysplashsurf", "openvdb", "distributed"}


def modules_after(statement: str) -> set[str]:
    """Modules, and top-level packages, that a fresh interpreter has loaded after a statement."""
    code = f"import sys; {statement}; print(*sys.modules, *{{name.partition('.')[0] for name in sys.modules}})"
    child = subprocess.run([sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True, check=True)
    return set(child.stdout.split())


@pytest.mark.parametrize(
    "statement",
    [
        "import pipeline.cli.main",
        "import pipeline.__main__",
        "import pipeline.stages",
        "from pipeline import Scene, submit",
        "from pipeline.job.loading import load_job",
        "import pipeline.job.schema",
        "import sim.shapes, sim.scene",
        "import render.parameters, render.spec",
    ],
)
def test_import_loads_neither_physics_nor_blender(statement):
    assert modules_after(statement) & HEAVY == set()


def test_the_package_by_itself_loads_nothing_of_it():
    assert {name for name in modules_after("import pipeline") if name.startswith("pipeline.")} == set()


def test_help_needs_no_arrays_and_no_tables():
    """`pipeline --help` answers at once."""
    assert modules_after("import pipeline.cli.main") & {"numpy", "rich", "h5py"} == set()


def test_the_state_of_a_job_needs_no_models_of_kinds_and_no_progress_bars():
    """`pipeline status` answers soon."""
    loaded = modules_after("import pipeline.cli.main, pipeline.queue.listing, pipeline.run.solver_numbers")
    assert loaded & {"pipeline.kinds.table", "pipeline.model.job", "rich"} == set()


def test_import_contracts_hold():
    lint = Path(sys.executable).with_name("lint-imports")
    child = subprocess.run([lint, "--no-cache"], cwd=PROJECT, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stdout


def test_only_the_entrances_to_blender_import_it():
    entrances = {"render/blender.py"}
    importing = {
        path.relative_to(PROJECT).as_posix()
        for folder in ("pipeline", "render", "sim", "blender_scripts")
        for path in (PROJECT / folder).rglob("*.py")
        if re.search(r"^\s*(import|from) bpy\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert {path for path in importing if not path.startswith("blender_scripts/")} <= entrances


def test_lock_pins_every_package_with_hashes_and_names_no_host():
    lock = (PROJECT / "requirements.lock").read_text(encoding="utf-8")
    assert not re.search(r"://|--(extra-)?index-url|--find-links|--trusted-host", lock)
    requirements = re.split(r"\n(?=[A-Za-z0-9])", lock)
    assert len(requirements) > 20
    for requirement in requirements:
        assert re.match(r"[A-Za-z0-9._-]+==\S+", requirement)
        assert "--hash=sha256:" in requirement


def test_every_direct_requirement_is_locked():
    settings = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))
    project = settings["project"]
    extras = project["optional-dependencies"].values()
    lines = [*project["dependencies"], *chain(*extras), *settings["dependency-groups"]["dev"]]
    names = {re.match(r"[A-Za-z0-9._-]+", line).group().lower() for line in lines}
    locked = set(
        re.findall(r"^([A-Za-z0-9._-]+)==", (PROJECT / "requirements.lock").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert names <= {name.lower() for name in locked}


def test_scripts_are_executable_and_valid_shell():
    for script, shell in (("run", "sh"), (".ci/run", "bash")):
        path = PROJECT / script
        assert path.stat().st_mode & 0o111
        subprocess.run([shell, "-n", path], check=True)


def test_the_container_gets_every_file_that_it_copies():
    """And no other: what `.dockerignore` lets through is what `Containerfile` names."""
    copied = {
        source
        for line in (PROJECT / "Containerfile").read_text(encoding="utf-8").splitlines()
        if line.startswith("COPY ")
        for source in line.split()[1:-1]
    }
    assert all((PROJECT / source).exists() for source in copied)
    allowed = re.findall(r"^!(\S+)$", (PROJECT / ".dockerignore").read_text(encoding="utf-8"), re.MULTILINE)
    assert {source.partition("/")[0] for source in copied} == set(allowed)


def test_the_version_to_cite_is_the_programs():
    cited = re.search(r"^version: (\S+)$", (PROJECT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited[1] == pipeline.__version__


def test_no_two_test_files_have_one_name():
    """Pytest imports them by it, and collects only the first; each alone would pass."""
    seen: dict[str, Path] = {}
    for path in sorted((PROJECT / "tests").rglob("*.py")):
        if path.name not in ("conftest.py", "__init__.py"):
            assert path.name not in seen, f"{path} and {seen[path.name]}"
            seen[path.name] = path
