"""A tiny film for the acceptance tests, made by the real command line in real processes."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import psutil
from blake3 import blake3
from command_line import pipeline as command
from places import PROJECT
from processes_seen import lives

from pipeline.base.errors import ManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskId
from pipeline.record.reader import SUCCEEDED, AttemptRow, ManifestReader
from pipeline.stages import STAGES

LOOKS = {"clean", "explain", "plan", "status", "verify"}
PATIENCE_S = 900.0
"""A film takes some 20 s on two idle cores, and minutes where others are busy and kernels are compiled anew after each
kill; only a hang gets here."""

FRAMES = 6
STAGE_NAMES = [
    stage.name for stage in STAGES if stage.name not in ("animated", "soft", "embers", "bounds") and not stage.on_demand
]
"""Those that the small films have: their cameras do not frame the action, and no file animates their bodies."""
ARTIFACT_SUFFIXES = {".h5", ".ply", ".vdb", ".png", ".mp4"}

SPLASH = f"""\
name = "tiny"
frames = {FRAMES}
device = "cpu"

[domain]
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]

[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.08 }}
position = [0.0, 0.0, 0.12]

[[fluid]]
name = "water"
particle_radius = 0.02

[[fluid.block]]                # thrown at the ball: it splashes within these few frames
shape = {{ type = "box", size = [0.24, 0.24, 0.2] }}
position = [0.0, 0.0, 0.32]
velocity = [0.0, 0.0, -3.0]

[whitewater.water]

[render]
resolution = [64, 36]
quality = "draft"
samples = 2
"""
"""Water on a ball: a simulation begins within two seconds, as it has few kernels."""

JOB = f"""\
{SPLASH}
[[cloth]]                      # thrown into a corner: it meets the floor and two walls within these few frames
name = "sheet"
shape = {{ type = "rectangle", size = [0.2, 0.2], counts = [7, 7] }}
position = [0.18, -0.18, 0.08]
rotation_deg = [20.0, 30.0, 10.0]
velocity = [2.0, -2.0, -1.0]

[[smoke]]
name = "plume"
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]
cell_size = 0.05

[[smoke.source]]
shape = {{ type = "sphere", radius = 0.1 }}
position = [-0.15, 0.1, 0.12]
temperature = 420.0
"""
"""The same with a sheet and smoke, so that it has every stage: a simulation begins within twenty seconds."""


@dataclass(frozen=True)
class Finished:
    """How a command ended."""

    code: int
    out: str
    err: str

    def assert_code(self, code: int) -> Finished:
        assert self.code == code, f"exit code {self.code}\n{self.out}\n{self.err}"
        assert "Traceback" not in self.err, self.err
        return self


@dataclass(frozen=True)
class Studio:
    """A working folder with the job file in it and, once submitted, the job's folder."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, job: str = JOB) -> Studio:
        """A studio where nothing was submitted yet."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "tiny.toml").write_text(job)
        return cls(folder)

    def copy(self, folder: Path) -> Studio:
        """All of it elsewhere; modification times stay, so that nothing looks touched."""
        return Studio(Path(shutil.copytree(self.folder, folder, dirs_exist_ok=True)))

    @property
    def layout(self) -> JobLayout:
        return JobLayout(self.folder / "renders" / "tiny")

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command, in a session of its own, as a shell would."""
        return subprocess.Popen(
            [sys.executable, "-m", "pipeline", *arguments],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(PROJECT)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(self, *arguments: str) -> Finished:
        """Run a command to its end: what starts tasks, and is what a user starts, in a process of its own."""
        if arguments[0] not in LOOKS:
            return finish(self.start(*arguments))
        with chdir(self.folder):
            result = command(*arguments)
        return Finished(result.exit_code, result.stdout, result.stderr)

    def submit(self, *arguments: str) -> Finished:
        """Submit the job and expect success."""
        return self.run("submit", "tiny.toml", *arguments).assert_code(0)

    # --- what is in the job's folder ---

    def artifacts(self) -> dict[str, str]:
        """Hash of every artifact on disk, by its path; edited files, checkpoints and preview movies are none."""
        root = self.layout.root
        others = {self.layout.checkpoints, self.layout.preview_scratch}
        return {
            path.relative_to(root).as_posix(): blake3(path.read_bytes()).hexdigest()
            for path in root.rglob("*")
            if path.suffix in ARTIFACT_SUFFIXES and path.parent not in others and path != self.layout.preview_movie
        }

    def mtimes_ns(self) -> dict[str, int]:
        """Modification time of every artifact, by its path."""
        return {artifact: (self.layout.root / artifact).stat().st_mtime_ns for artifact in self.artifacts()}

    def histories(self) -> dict[TaskId, list[AttemptRow]]:
        """Every attempt of every planned task."""
        with ManifestReader.open_readonly(self.layout.manifest) as manifest:
            return {task: manifest.history(task) for task in manifest.states()}

    def attempts(self) -> dict[TaskId, int]:
        """Number of attempts of every planned task."""
        return {task: len(history) for task, history in self.histories().items()}

    def tasks_run_since(self, before: dict[TaskId, int]) -> set[TaskId]:
        """Tasks with more attempts than before."""
        return {task for task, count in self.attempts().items() if count != before.get(task, 0)}

    def running(self) -> list[AttemptRow]:
        """Attempts under way; none before there is a manifest."""
        if not self.layout.manifest.exists():
            return []
        try:
            with ManifestReader.open_readonly(self.layout.manifest) as manifest:
                return manifest.running_attempts()
        except ManifestError:  # it is being made at this moment
            return []

    def worker_of(self, attempt: AttemptRow) -> int | None:
        """Process that has begun the attempt, from its log; None if it has not begun yet."""
        log = self.layout.log(attempt.task, attempt.number)
        begun = re.search(
            rf"^{re.escape(attempt.task)}, attempt {attempt.number}, on .*, process (\d+)$",
            log.read_text() if log.exists() else "",
            re.MULTILINE,
        )
        return int(begun[1]) if begun else None

    def wait_for_attempt(
        self, runner: subprocess.Popen[str], stages: Iterable[str] = STAGE_NAMES
    ) -> tuple[AttemptRow, int] | None:
        """An attempt of one of these stages in the middle of its work, with its process; None if the runner ends first.

        The simulation is in the middle when it has committed two frames. Attempts of a killed runner stay listed until
        the next one has looked at them; their processes are gone.
        """
        wanted = set(stages)
        until = time.monotonic() + PATIENCE_S
        while runner.poll() is None:
            assert time.monotonic() < until, f"{wanted} never ran"
            for attempt in self.running():
                worker = self.worker_of(attempt) if stage_of(attempt.task) in wanted else None
                if worker is None or not psutil.pid_exists(worker):
                    continue
                if attempt.task != "simulate" or self._frames_simulated() >= 2:
                    return attempt, worker
            time.sleep(0.01)
        return None

    def wait_for_end(self, attempt: AttemptRow) -> None:
        """Wait until the runner has noticed an attempt's end."""
        until = time.monotonic() + PATIENCE_S
        while any((each.task, each.number) == (attempt.task, attempt.number) for each in self.running()):
            assert time.monotonic() < until, f"{attempt.task} never ended"
            time.sleep(0.01)

    def _frames_simulated(self) -> int:
        return sum(1 for _ in (self.layout.receipts / "cache").glob("*.json"))

    # --- what has to hold after whatever happened ---

    def assert_whole(self, like: Studio) -> None:
        """Every artifact is byte for byte that of another studio, and nothing was left lying about."""
        mine, theirs = self.artifacts(), like.artifacts()
        assert mine.keys() == theirs.keys()
        assert [path for path in mine if mine[path] != theirs[path]] == []
        left_over = [path.name for path in self.layout.root.rglob("*") if ".part" in path.name]
        assert left_over == []

    def assert_nothing_done_twice(self, since: Mapping[TaskId, int] = MappingProxyType({})) -> None:
        """No task was tried again after it had succeeded; earlier attempts, of which there were so many, aside."""
        for task, history in self.histories().items():
            outcomes = [attempt.outcome for attempt in history[since.get(task, 0) :]]
            assert SUCCEEDED not in outcomes[:-1], f"{task}: {outcomes}"


@contextmanager
def standing_still(worker: int) -> Iterator[None]:
    """Stop a worker's clock inside the block; it may be killed meanwhile."""
    os.kill(worker, signal.SIGSTOP)
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGCONT)


def listen(process: subprocess.Popen[str], sentence: str) -> str:
    """What a command prints on standard error up to this sentence."""
    assert process.stderr is not None
    heard = ""
    while sentence not in heard:
        line = process.stderr.readline()
        assert line, heard
        heard += line
    return heard


def stage_of(task: str) -> str:
    """`render/000012` -> `render`."""
    return task.partition("/")[0]


def finish(process: subprocess.Popen[str]) -> Finished:
    """Wait for a command's end."""
    try:
        out, err = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return Finished(process.returncode, out, err)


def family_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """All its descendants."""
    return psutil.Process(process.pid).children(recursive=True)


def assert_all_gone(processes: Iterable[psutil.Process]) -> None:
    """They die with whom they serve; a moment later, as the kernel has to tell them."""
    _, alive = psutil.wait_procs(list(processes), timeout=30.0)
    assert [process for process in alive if lives(process)] == []


def kill(process: subprocess.Popen[str]) -> None:
    """Kill -9 a runner, and nothing of it lives on."""
    family = family_of(process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert_all_gone(family)
