"""The wheel, built offline and installed in an environment of its own: used from another folder, film and all."""

import subprocess
import sys
import sysconfig
import zipfile
from itertools import chain
from pathlib import Path

import pytest
from needed_blender import needs_bpy
from places import PROJECT, UV

BUILD = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"


def ran(*argv: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        argv, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600, check=False
    )


def printed(*argv: object, cwd: Path) -> str:
    completed = ran(*argv, cwd=cwd)
    assert completed.returncode == 0, completed.stdout + completed.stderr
    return completed.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    return folder / printed(sys.executable, "-c", BUILD, folder, cwd=PROJECT)


def test_wheel_holds_every_file_of_the_packages_and_nothing_else(wheel):
    packages = ("blender_scripts", "pipeline", "render", "sim")
    files = printed("git", "ls-files", "--cached", "--others", "--exclude-standard", *packages, cwd=PROJECT)
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == {name for name in files.splitlines() if (PROJECT / name).exists()}


@needs_bpy
@pytest.mark.slow
@pytest.mark.skipif(UV is None, reason="uv is neither on PATH nor in .tools; it installs the wheel")
def test_wheel_makes_a_film_from_another_folder(wheel, tmp_path):
    """All but the wheel comes from the packages that run this test."""
    python, pipeline = (tmp_path / "env" / "bin" / name for name in ("python", "pipeline"))
    uv = [UV, "--quiet", "--offline", "--no-config"]
    printed(*uv, "venv", "--no-project", "--python", sys.executable, tmp_path / "env", cwd=tmp_path)
    printed(*uv, "pip", "install", "--no-deps", "--python", python, wheel, cwd=tmp_path)
    own = printed(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path)
    (Path(own) / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")

    folder = tmp_path / "elsewhere"
    folder.mkdir()
    assert printed(python, "-c", "import pipeline; print(pipeline.__file__)", cwd=folder).startswith(own)
    assert printed(pipeline, "--version", cwd=folder).startswith("pipeline, version ")
    printed(pipeline, "new", "tiny", cwd=folder)
    assert "tiny.toml: ok" in printed(pipeline, "check", "tiny", cwd=folder)
    changes = (
        "duration=0.05",
        "fluid.water.particle_radius=0.015",
        "render.resolution=[64,36]",
        "render.quality=draft",
    )
    printed(pipeline, "submit", "tiny", *chain(*(("--set", change) for change in changes)), "--farm", ".", cwd=folder)
    film = folder / "tiny"
    assert (film / "movie.mp4").stat().st_size > 0
    assert len(list((film / "frames").glob("*.png"))) == 3


@needs_bpy
def test_blender_scripts_beside_packages_of_another_python_do_not_import_these(wheel, tmp_path):
    """As Blender's own Python runs them from the folder where the wheel and, say, another numpy are installed."""
    zipfile.ZipFile(wheel).extractall(tmp_path)
    (tmp_path / "numpy.py").write_text("raise ImportError('of another Python')\n")
    script = tmp_path / "blender_scripts" / "render_frames.py"
    spec = tmp_path / "absent.json"
    drawn = ran(sys.executable, script, spec, "--threads", "1", "--gpu", "none", cwd=tmp_path)
    assert "RENDERER_FAILED" in drawn.stdout and "absent.json" in drawn.stdout, drawn.stdout + drawn.stderr
