"""What a frame of a job asks of the device: launches by kernel, and copies, with the host's time; JSON.

    python -m benchmarks.launches jobs/everything.toml --after 5 --frames 5 [--device cuda]

Kernels that return something wait for the device, so that their time is that of others, too. On a CPU a launch ends
with its kernel; on a GPU its time is what the host needs to hand it over, of which small scenes are made.
"""

import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.compare import arguments_of, machine, run, start_taichi
from pipeline.job.loading import load_job


class Counter:
    """Counts calls, and the time that they take."""

    def __init__(self) -> None:
        self._spent: dict[str, list[float]] = defaultdict(list)

    def counted(self, call: Callable[..., Any], name: Callable[..., str]) -> Callable[..., Any]:
        """The same function, of which each call is counted under the name that its arguments give."""

        def counting(*arguments: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*arguments)
            finally:
                self._spent[name(*arguments)].append(time.perf_counter() - began)

        return counting

    def forget(self) -> None:
        """Count anew."""
        self._spent.clear()

    def per_frame(self, frames: int) -> dict[str, dict[str, float]]:
        """Number, and time of the host [ms], of each name in a frame, by time; the sums of all first."""
        rows = {name: (len(spent) / frames, 1e3 * sum(spent) / frames) for name, spent in self._spent.items()}
        rows = dict(sorted(rows.items(), key=lambda row: -row[1][1]))
        rows = {"all": (sum(n for n, _ in rows.values()), sum(ms for _, ms in rows.values())), **rows}
        return {name: {"a_frame": number, "host_ms": ms} for name, (number, ms) in rows.items()}


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("job", type=Path)
    parser.add_argument("--after", type=int, default=5, help="frames that are not counted, for kernels to compile")
    parser.add_argument("--frames", type=int, default=5)
    arguments = start_taichi(parser)
    from sim.build import build_world
    from sim.core import host_access
    from sim.core.launch import FastKernel

    counter = Counter()
    FastKernel.__call__ = counter.counted(FastKernel.__call__, lambda kernel, *_: kernel.__name__)
    host_access._ask_driver = counter.counted(host_access._ask_driver, lambda function, *_: function)
    job = load_job(arguments.job)
    world = build_world(job, frames_per_second=job.fps)
    for _ in range(arguments.after):
        world.advance_frame()
    counter.forget()
    times, substeps = [], []
    for _ in range(arguments.frames):
        began = time.perf_counter()
        report = world.advance_frame()
        times.append(time.perf_counter() - began)
        substeps.append(max(report.substeps.values()))
    return {
        **machine(arguments.device),
        "frame_ms": 1e3 * statistics.median(times),
        "substeps_a_frame": statistics.mean(substeps),
        "calls": counter.per_frame(arguments.frames),
    }


if __name__ == "__main__":
    run(main)
