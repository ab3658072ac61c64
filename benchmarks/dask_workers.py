"""Frames a minute with one and with two Dask workers of one core each, in turns.

    python -m benchmarks.dask_workers --pairs 3 --frames 16

A small scene is simulated once; then its frames are drawn again and again, by one worker and by two. The rate counts
from the moment when every worker has drawn its first frame, for which it starts Blender. What else the machine does
takes cores from both: the ratio within a pair tells more than either rate.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import psutil

from pipeline.executors.base import Committed
from pipeline.executors.dask import DaskExecutor
from pipeline.executors.dask_local import local_cluster, split
from pipeline.executors.processes import ProcessExecutor
from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.run_control import Selection
from pipeline.run_events import RunEvent
from pipeline.runner import run_job
from pipeline.scheduler_events import JobOutcome
from pipeline.task import Resources

JOB = """
name = "scaling"
frames = {frames}
device = "cpu"

[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.1 }}
position = [0.0, 0.0, 0.5]
kind = "dynamic"
density = 500.0

[render]
resolution = [{width}, {height}]
samples = {samples}
"""
MEMORY_BYTES = 4_000_000_000


class Clock:
    """Notes when each picture was committed, monotonic [s]."""

    def __init__(self) -> None:
        self.pictures: list[float] = []

    def notify(self, event: RunEvent) -> None:
        if isinstance(event, Committed) and event.receipt.artifact.startswith("frames/"):
            self.pictures.append(time.monotonic())

    def frames_a_minute(self, workers: int) -> float:
        """Rate after each worker's first picture."""
        counted = self.pictures[workers - 1 :]
        return 60.0 * (len(counted) - 1) / (counted[-1] - counted[0])


def pin_to_a_core_each(workers: int) -> None:
    """Give each Dask worker a core of its own, which its worker processes inherit: a machine with one core.

    Without that a worker of one thread is no worker of one core: Cycles keeps a second thread busy waiting.
    """
    children = psutil.Process().children(recursive=True)
    dask_workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    assert len(dask_workers) == workers
    for process, core in zip(dask_workers, sorted(os.sched_getaffinity(0)), strict=False):
        process.cpu_affinity([core])
        for thread in process.threads():
            os.sched_setaffinity(thread.id, [core])


def measure(layout: JobLayout, workers: int) -> float:
    job, clock = load_job(layout.job_file), Clock()
    shares = split(Resources(cores=workers, memory_bytes=workers * MEMORY_BYTES), workers)
    with local_cluster(shares) as address, DaskExecutor(address, layout.root, of_runner=True) as executor:
        while executor.capacity.cores < workers:
            executor.wait(0.5)
        pin_to_a_core_each(workers)
        outcome = run_job(
            job,
            layout,
            executor=executor,
            observer=clock,
            rerun=Selection(frozenset({"render"})),
            capacity=executor.capacity,
            machine=executor.machine,
        )
    assert outcome.kind is JobOutcome.SUCCEEDED, outcome
    assert len(clock.pictures) == job.frame_count
    return clock.frames_a_minute(workers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--resolution", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", type=Path, help="write the rates to this file")
    options = parser.parse_args()
    width, height = options.resolution
    text = JOB.format(frames=options.frames, width=width, height=height, samples=options.samples)
    with tempfile.TemporaryDirectory() as folder:
        layout = JobLayout(Path(folder) / "scaling")
        layout.root.mkdir()
        layout.job_file.write_text(text)
        with ProcessExecutor() as executor:
            outcome = run_job(load_job(layout.job_file), layout, executor=executor)
        assert outcome.kind is JobOutcome.SUCCEEDED, outcome
        pairs = []
        for number in range(options.pairs):
            # Whoever goes first meets another state of the machine: take turns.
            order = (1, 2) if number % 2 == 0 else (2, 1)
            rates = {workers: measure(layout, workers) for workers in order}
            pairs.append(rates)
            print(f"{rates[1]:7.1f} {rates[2]:7.1f} frames/min   ratio {rates[2] / rates[1]:.2f}", flush=True)
    ratios = [rates[2] / rates[1] for rates in pairs]
    print(f"median ratio {statistics.median(ratios):.2f} (from {min(ratios):.2f} to {max(ratios):.2f})")
    if options.json is not None:
        options.json.write_text(json.dumps(pairs, indent=1) + "\n")


if __name__ == "__main__":
    main()
