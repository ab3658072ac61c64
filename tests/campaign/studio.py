"""Where a campaign works: the tiny job, a Blender of its own, and what can be seen of a run from outside."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from blake3 import blake3

PROJECT = Path(__file__).resolve().parents[2]
HOOKS = Path(__file__).with_name("hooks")
NAME = "tiny"
FRAMES = 8
ARTIFACT_SUFFIXES = {".h5", ".ply", ".vdb", ".png", ".mp4"}
SO_FAR = "so-far"
"""In the names of the preview movie, and of the folder in which it is made."""

BALL = """\
[[rigid]]
name = "ball"
kind = "dynamic"
shape = { type = "sphere", radius = 0.08 }
position = [0.0, 0.0, 0.12]
density = 500
velocity = [0.0, 0.0, -1.0]
"""
SMOKE = """
[[smoke]]
name = "plume"
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]
cell_size = 0.06

[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [-0.15, 0.1, 0.12]
temperature = 420.0
"""
WATER = """
[[fluid]]
name = "water"
particle_radius = 0.03
[[fluid.block]]
shape = { type = "box", size = [0.24, 0.24, 0.18] }
position = [0.15, -0.15, 0.1]
"""
CLOTH = """
[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [0.3, 0.3], counts = [9, 9] }
position = [0.0, 0.0, 0.3]
[[cloth.pin]]
corner = "x-y-"
"""
SCENES = {"ball": BALL, "smoke": BALL + SMOKE, "all": BALL + SMOKE + WATER + CLOTH}
"""What is simulated: a ball starts in a second or two, smoke compiles its kernels for ten, all kinds for longer."""

JOB = """\
name = "{name}"
frames = {frames}
device = "cpu"

[domain]
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]

{scene}
[render]
resolution = [32, 18]
quality = "draft"
samples = 1
device = "cpu"                  # a GPU may compile for minutes before its first frame

{limits}"""
LIMITS = """\
[limits.{stage}]
stall_s = {stall_s}
memory_gb = 2
"""
STALL_S = {"all": 120}
"""Longest time without a sign of life, by scene, where it is not 30 s: kernels compile in silence."""
STAGES = ("bodies", "simulate", "surface", "cloth", "volume", "render", "movie")

BLENDER = """\
#!{python}
import runpy, sys
arguments = sys.argv[1:]
if arguments == ["--version"]:
    from importlib.metadata import version
    print("Blender", version("bpy"))
    sys.exit()
runpy.run_path(arguments[arguments.index("--python") + 1], run_name="__main__")
"""


def is_artifact(path: Path) -> bool:
    """Whether a file of a job's folder is to be the same after every run; a preview movie is gone then."""
    return (
        path.suffix in ARTIFACT_SUFFIXES
        and path.parent.name != "checkpoints"
        and ".part." not in path.name
        and SO_FAR not in path.parent.name + path.name
    )


@dataclass(frozen=True)
class Studio:
    """A folder with the job's file, a Blender executable (the bpy module's), control files and the job's own folder."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, *, scene: str) -> Studio:
        """A studio where nothing was submitted yet."""
        studio = cls(folder)
        for each in (studio.control, studio.renders, studio.temporary):
            each.mkdir(parents=True)
        studio.blender.write_text(BLENDER.format(python=sys.executable))
        studio.blender.chmod(0o755)
        limits = "\n".join(LIMITS.format(stage=stage, stall_s=STALL_S.get(scene, 30)) for stage in STAGES)
        text = JOB.format(name=NAME, frames=FRAMES, scene=SCENES[scene], limits=limits)
        (folder / f"{NAME}.toml").write_text(text)
        return studio

    @property
    def control(self) -> Path:
        """Files that tell the processes what goes wrong; see `hooks/sitecustomize.py`."""
        return self.folder / "control"

    @property
    def renders(self) -> Path:
        """Parent of the job's folder."""
        return self.folder / "renders"

    @property
    def temporary(self) -> Path:
        """Where all processes have their temporary files."""
        return self.folder / "temporary"

    @property
    def root(self) -> Path:
        """The job's folder."""
        return self.renders / NAME

    @property
    def blender(self) -> Path:
        """The executable that draws."""
        return self.folder / "blender"

    def submit(self) -> subprocess.Popen[bytes]:
        """Submit the job; on a disk of any size."""
        return self.start("submit", f"{NAME}.toml", "--reserve", "0", "--set", f"render.blender={self.blender}")

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a pipeline command; what it prints goes to the end of `out.txt`."""
        with (self.folder / "out.txt").open("ab") as out:
            return subprocess.Popen(
                [sys.executable, "-m", "pipeline", *arguments],
                cwd=self.folder,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join([str(HOOKS), str(PROJECT)]),
                    "CAMPAIGN_CONTROL": str(self.control),
                    "TMPDIR": str(self.temporary),
                },
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    def tell(self, name: str, text: str) -> None:
        """Write a control file at once as a whole."""
        part = self.control / f".{name}"
        part.write_text(text)
        part.replace(self.control / name)

    def untell(self, *names: str) -> None:
        """Take control files back."""
        for name in names:
            (self.control / name).unlink(missing_ok=True)

    # --- what can be seen ---

    def artifacts(self) -> dict[str, str]:
        """Hash of every artifact on disk by its path; files that were kept aside and checkpoints are none."""
        return {
            path.relative_to(self.root).as_posix(): blake3(path.read_bytes()).hexdigest()
            for path in self.root.rglob("*")
            if is_artifact(path)
        }

    def states(self) -> dict[str, str]:
        """State of every planned task; none while there is no record, or it cannot be read at this moment."""
        return dict(self._query("SELECT id, state FROM task WHERE position IS NOT NULL"))

    def attempts(self) -> list[tuple[str, int, str]]:
        """Task, number and outcome of every attempt that has ended, in order."""
        return self._query("SELECT task, number, outcome FROM attempt WHERE finished IS NOT NULL ORDER BY task, number")

    def recorded(self) -> dict[str, str]:
        """Hash of every artifact that the record knows."""
        return dict(self._query("SELECT path, hash FROM artifact"))

    def commits(self) -> list[str]:
        """Artifacts in the order in which they were committed, as often as they were."""
        path = self.control / "commits"
        return [line.removesuffix(".json") for line in path.read_text().splitlines()] if path.exists() else []

    def printed(self) -> str:
        """All that the commands printed."""
        return (self.folder / "out.txt").read_text(errors="replace")

    def _query(self, sql: str) -> list[tuple[str, ...]]:
        database = self.root / "manifest.db"
        if not database.exists():
            return []
        try:
            with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=5.0)) as connection:
                return connection.execute(sql).fetchall()
        except sqlite3.Error:  # it is being made, or on a disk that is full at this moment
            return []
