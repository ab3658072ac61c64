"""`./run` on a copy of itself: a tiny project in a folder with a space in its name, whose lock holds one tiny wheel.

The real uv makes real environments; nothing is fetched.
"""

import base64
import hashlib
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from places import PROJECT, UV

pytestmark = pytest.mark.skipif(UV is None, reason="uv is neither on PATH nor in .tools; ./run would fetch it")


def wheel(folder: Path, value: int) -> str:
    """Build a wheel of one module, `tiny`, and return the requirement that installs it, with its hash."""
    path = folder / f"tiny-{value}.0-py3-none-any.whl"
    files = {
        "tiny.py": f"VALUE = {value}\n",
        f"tiny-{value}.0.dist-info/METADATA": f"Metadata-Version: 2.1\nName: tiny\nVersion: {value}.0\n",
        f"tiny-{value}.0.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = f"tiny-{value}.0.dist-info/RECORD"
    digests = {name: base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()) for name, text in files.items()}
    files[record] = "".join(
        f"{name},sha256={digest.decode().rstrip('=')},{len(files[name])}\n" for name, digest in digests.items()
    )
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return f"tiny @ {path.as_uri()} --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    root = tmp_path / "my project"
    (root / "pipeline").mkdir(parents=True)
    (root / "render").mkdir()
    shutil.copy2(PROJECT / "run", root / "run")
    (root / "pipeline" / "__init__.py").touch()
    (root / "pipeline" / "__main__.py").write_text("import sys\nprint('ours', *sys.argv[1:])\n")
    shutil.copy2(PROJECT / "render" / "system_libraries.py", root / "render")
    (root / "requirements.lock").write_text(wheel(tmp_path, 1))
    return root


def environment(*, with_uv: bool) -> dict[str, str]:
    """This process's environment, without what pytest's own virtual environment put there."""
    path = os.pathsep.join([str(Path(UV).parent)] * with_uv + ["/usr/bin", "/bin"])
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PIPELINE_", "VIRTUAL_ENV"))}
    return {**kept, "PATH": path, "PIPELINE_PYTHON": sys.executable}


def run(project: Path, *arguments: str, with_uv: bool = True, **options) -> subprocess.CompletedProcess[str]:
    options = {"env": environment(with_uv=with_uv), "cwd": project.parent, **options}
    return subprocess.run(
        [project / "run", *arguments], capture_output=True, text=True, check=False, timeout=120, **options
    )


def test_first_call_makes_the_environment_and_the_second_needs_no_uv(project):
    first = run(project, "python", "-c", "import tiny, pipeline; print(tiny.VALUE)")
    assert (first.returncode, first.stdout) == (0, "1\n"), first.stderr
    assert "setting up" in first.stderr
    second = run(project, "python", "-c", "import sys; print(sys.prefix)", with_uv=False)
    assert (second.returncode, second.stdout, second.stderr) == (0, f"{project}/.venv\n", "")
    assert [path.name for path in (project / ".tools").iterdir()] == ["lock"]


def test_changed_lock_is_installed_at_the_next_call(project):
    assert run(project, "true").returncode == 0
    (project / "requirements.lock").write_text(wheel(project.parent, 2))
    again = run(project, "python", "-c", "import tiny; print(tiny.VALUE)")
    assert (again.returncode, again.stdout) == (0, "2\n"), again.stderr


def test_wheel_with_another_hash_is_refused_and_the_environment_stays_unfinished(project):
    lock = project / "requirements.lock"
    lock.write_text(lock.read_text().rpartition(":")[0] + ":" + "0" * 64 + "\n")
    assert run(project, "true").returncode != 0
    assert not (project / ".venv" / ".up-to-date").exists()


def test_two_first_calls_at_once_both_succeed(project):
    calls = [
        subprocess.Popen(
            [project / "run", "python", "-c", "import tiny"], env=environment(with_uv=True), stderr=subprocess.PIPE
        )
        for _ in range(3)
    ]
    complaints = [call.communicate(timeout=120)[1].decode() for call in calls]
    assert [call.returncode for call in calls] == [0, 0, 0], complaints
    assert sum("setting up /" in complaint for complaint in complaints) == 1


def test_pipeline_is_a_command_and_the_callers_folder_is_kept(project, tmp_path):
    decoy = tmp_path / "elsewhere" / "pipeline"
    decoy.mkdir(parents=True)
    (decoy / "__init__.py").write_text("raise SystemExit('the wrong package')")
    result = run(project, "pipeline", "submit", "a file.toml", cwd=decoy.parent)
    assert (result.returncode, result.stdout) == (0, "ours submit a file.toml\n"), result.stderr
    where = run(project, "pwd", cwd=decoy.parent)
    assert where.stdout == f"{decoy.parent}\n"
    activated = f'. "{project}/.venv/bin/activate" && pipeline status'
    shell = subprocess.run(["sh", "-c", activated], cwd=decoy.parent, capture_output=True, text=True, check=True)
    assert shell.stdout == "ours status\n"


def test_exit_code_is_the_commands(project):
    assert run(project, "sh", "-c", "exit 7").returncode == 7


def test_environment_may_lie_elsewhere(project, tmp_path):
    env = {**environment(with_uv=True), "PIPELINE_VENV": "other place/venv"}
    result = run(project, "python", "-c", "import sys; print(sys.prefix)", env=env, cwd=tmp_path)
    assert result.stdout == f"{tmp_path}/other place/venv\n", result.stderr
    assert not (project / ".venv").exists()


def test_python_that_does_not_work_is_told_in_a_line(project):
    env = {**environment(with_uv=True), "PIPELINE_PYTHON": "/bin/false"}
    result = run(project, "true", env=env)
    assert (result.returncode, result.stderr) == (1, "run: PIPELINE_PYTHON=/bin/false is not a Python 3.11 to 3.13\n")


def test_called_through_a_link_it_finds_its_project(project, tmp_path):
    (tmp_path / "bin").mkdir()
    link = tmp_path / "bin" / "physics"
    link.symlink_to(project / "run")
    result = subprocess.run(
        [link, "pipeline", "x"], env=environment(with_uv=True), capture_output=True, text=True, check=False, timeout=120
    )
    assert (result.returncode, result.stdout) == (0, "ours x\n"), result.stderr


@pytest.mark.parametrize("quoted", [False, True], ids=["a folder", "an address"])
def test_folder_that_pip_would_look_in_and_that_is_not_there_is_no_obstacle(project, tmp_path, quoted):
    there = tmp_path / "wheels and more" if quoted else tmp_path / "wheels"
    there.mkdir()
    requirement = wheel(there, 3)
    digest = requirement.rpartition(" ")[2].strip()
    (project / "requirements.lock").write_text(f"tiny==3.0 {digest}\n")
    missing = tmp_path / "mounted elsewhere" if quoted else tmp_path / "missing"
    places = [path.as_uri() if quoted else str(path) for path in (missing, there)]
    stand_in = project / ".tools" / "uv" / "bin" / "python"  # whose pip tells its settings
    stand_in.parent.mkdir(parents=True)
    listed = "".join(f"\\\\n{place}" for place in places)
    stand_in.write_text(f"#!/bin/sh\nprintf '%s\\n' \"global.find-links='{listed}'\" \"global.no-index='true'\"\n")
    stand_in.chmod(0o755)
    kept = {name: value for name, value in environment(with_uv=True).items() if not name.startswith("UV_")}
    alone = {"UV_NO_INDEX": "1", "XDG_CONFIG_HOME": str(tmp_path)}
    result = run(project, "python", "-c", "import tiny; print(tiny.VALUE)", env={**kept, **alone})
    assert (result.returncode, result.stdout) == (0, "3\n"), result.stderr
