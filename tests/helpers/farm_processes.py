"""A farm of synthetic jobs whose commands are real processes."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
import synthetic_stages
from command_line import pipeline as command
from synthetic_jobs import job_text

import pipeline.queue.turns  # before stages are exchanged: modules that it imports keep the real ones
import pipeline.stages
from pipeline.base.layout import JobLayout
from pipeline.base.lease import live_holder
from pipeline.queue.job_queue import JobQueue
from pipeline.record.reader import AttemptRow, ManifestReader

HERE = Path(__file__).resolve().parent
PATIENCE_S = 900.0
"""Only a hang, or a very busy machine, gets here."""
RUNS_TASKS = {"submit", "sweep", "resume", "rerun"}


class Ended(NamedTuple):
    code: int
    out: str
    err: str


class Farm:
    """A working folder with job files, and their farm `renders/`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.queue = JobQueue(folder / "renders")
        self._started: list[subprocess.Popen[str]] = []

    def job(self, name: str, *, frames: int = 6, pause_s: float = 0.0, focal_length_mm: float = 50.0) -> Path:
        """Write a job file; each of its frames takes `pause_s` in each stage."""
        path = self.folder / f"{name}.toml"
        text = job_text(frames=frames, focal_length_mm=focal_length_mm)
        path.write_text(text.replace('name = "synthetic"', f'name = "{name}"'))
        synthetic_stages.write_faults(self.layout(name).root, {}, pause_s=pause_s)
        return path

    def faults(self, name: str, faults: dict[str, list[str]], *, pause_s: float = 0.0) -> None:
        """Put faults into a job; from the next frame on each takes `pause_s`."""
        synthetic_stages.write_faults(self.layout(name).root, faults, pause_s=pause_s)

    def layout(self, name: str) -> JobLayout:
        return JobLayout(self.folder / "renders" / name)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, str(HERE / "synthetic_command.py"), *arguments],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parents[1])])},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._started.append(process)
        return process

    def run(self, *arguments: str, code: int | None = 0) -> Ended:
        """Run a command to its end; `code` is what it must exit with, None: whatever."""
        return self.finish(self.start(*arguments), code=code)

    def here(self, *arguments: str, code: int = 0) -> Ended:
        """Run a command to its end in this process, its tasks too: starting others takes seconds."""
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            patch.setattr(pipeline.stages, "STAGES", synthetic_stages.STAGES)
            patch.setattr(pipeline.queue.turns, "STAGES_REFERENCE", synthetic_stages.REFERENCE)
            executor = ("--executor", "inline") if arguments[0] in RUNS_TASKS else ()
            result = command(*arguments, *executor)
        assert result.exit_code == code, result.output
        return Ended(result.exit_code, result.stdout, result.stderr)

    @staticmethod
    def finish(process: subprocess.Popen[str], *, code: int | None = 0) -> Ended:
        out, err = process.communicate(timeout=PATIENCE_S)
        if code is not None:
            assert process.returncode == code, f"{process.args}: {process.returncode}\n{out}\n{err}"
        return Ended(process.returncode, out, err)

    def listed(self) -> dict[str, dict[str, Any]]:
        listed = json.loads(self.here("status", "--json").out)
        return {job["name"]: job for job in listed["jobs"]}

    def attempts(self, name: str) -> list[AttemptRow]:
        layout = self.layout(name)
        if not layout.manifest.exists():
            return []
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            return [row for task in manifest.states() for row in manifest.history(task)]

    def frames_done(self, name: str) -> int:
        return len([*self.layout(name).root.glob("double/*.bin")])

    def is_running(self, name: str) -> bool:
        return live_holder(self.layout(name).lease) is not None

    def settled(self, name: str) -> bool:
        """Whether nothing runs the job and nothing waits for it."""
        return self.queue.find(name) is None and not self.is_running(name)

    def close(self) -> None:
        """End whatever was started and still runs, runners in the background too."""
        for process in self._started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        holder = live_holder(self.queue.lease)
        if holder is not None:
            with suppress(psutil.NoSuchProcess):
                psutil.Process(holder.pid).kill()


def wait_until(condition: Callable[[], bool], what: str) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until, what
        time.sleep(0.02)
