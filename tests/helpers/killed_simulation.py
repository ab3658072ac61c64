"""Run a job's simulation, a checkpoint after every frame, and be killed in the middle of a write.

PYTHONPATH=.:tests python killed_simulation.py FOLDER write_frame|write_checkpoint FRAME
"""

import os
import signal
import sys
from pathlib import Path
from typing import Any

from inline_tasks import run_task

from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskId
from pipeline.job.loading import load_job
from pipeline.run.events import TaskEvent
from pipeline.stages import simulate as stage

TASK = TaskId("simulate")


def simulate(layout: JobLayout, *, attempt: int = 1) -> TaskEvent:
    """Run the task until it ends; returns how it ended."""
    (task,) = stage.SimulateStage().plan(load_job(layout.job_file), layout)
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # As many threads as every other test of this process that starts Taichi.
    return run_task(task, layout, attempt=attempt, threads=threads)


def kill_in(write: str, frame: int) -> None:
    """Have this process killed once the stage has written half of what it writes of a frame."""
    original = getattr(stage, write)

    def write_half(path: Path, *arguments: Any, **options: Any) -> None:
        original(path, *arguments, **options)
        number = arguments[1].frame if write == "write_frame" else arguments[0].frame
        if number == frame:
            os.truncate(path, path.stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    setattr(stage, write, write_half)
    stage.CHECKPOINT_INTERVAL_S = -1.0


if __name__ == "__main__":
    kill_in(sys.argv[2], int(sys.argv[3]))
    simulate(JobLayout(Path(sys.argv[1])))
