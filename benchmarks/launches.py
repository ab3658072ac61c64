"""What a frame of a job asks of the device: launches by kernel, and copies, with the host's time; JSON.

    python -m benchmarks.launches jobs/everything.toml --after 5 --frames 5 [--device cuda]

Kernels that return something wait for the device, so that their time is that of others, too. On a CPU a launch ends
with its kernel; on a GPU its time is what the host needs to hand it over, of which small scenes are made.
"""

import ctypes
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.compare import arguments_of, machine, run, start_taichi
from sim.core.cuda_driver import ask


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
        return table_of(rows, "host_ms")


class DeviceTimes:
    """Takes the time of a CUDA device for each launch, with the gap before it where the device had nothing to do."""

    def __init__(self) -> None:
        self._events: dict[str, list[tuple[ctypes.c_void_p, ctypes.c_void_p]]] = defaultdict(list)
        self._is_watching = False

    def watch(self) -> None:
        """From now on, if not yet; each launch takes the host some microseconds more."""
        from sim.core.launch import FastKernel

        if self._is_watching:
            return
        self._is_watching, launch = True, FastKernel._launch

        def watched(kernel: Any, *arguments: Any) -> Any:
            before = _event()
            context = launch(kernel, *arguments)
            self._events[kernel.__name__].append((before, _event()))
            return context

        FastKernel._launch = watched

    def per_frame(self, frames: int) -> dict[str, dict[str, float]]:
        """Number of launches, and time of the device [ms], of each kernel in a frame, by time; the sums of all first.

        Call after the device has done everything.
        """
        rows = {}
        for name, events in self._events.items():
            total = 0.0
            for before, after in events:
                took = ctypes.c_float()
                ask("cuEventElapsedTime", ctypes.byref(took), before, after)
                total += took.value
            rows[name] = (len(events) / frames, total / frames)
        return table_of(rows, "device_ms")


def _event() -> ctypes.c_void_p:
    """An event of the device behind all that was launched."""
    event = ctypes.c_void_p()
    ask("cuEventCreate", ctypes.byref(event), ctypes.c_uint(0))
    ask("cuEventRecord", event, None)
    return event


def table_of(rows: dict[str, tuple[float, float]], kind: str) -> dict[str, dict[str, float]]:
    """Number and time [ms] of each name in a frame, by time; the sums of all first."""
    rows = dict(sorted(rows.items(), key=lambda row: -row[1][1]))
    rows = {"all": (sum(n for n, _ in rows.values()), sum(ms for _, ms in rows.values())), **rows}
    return {name: {"a_frame": number, kind: ms} for name, (number, ms) in rows.items()}


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("job", type=Path)
    parser.add_argument("--after", type=int, default=5, help="frames that are not counted, for kernels to compile")
    parser.add_argument("--frames", type=int, default=5)
    arguments = start_taichi(parser)
    from pipeline.job.loading import load_job
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
