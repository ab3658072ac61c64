"""What the computing thread loses while a frame is written beside it; JSON on the standard output.

python benchmarks/frame_writing.py --particles 2000000
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.cache import validate_frame, write_frame
from pipeline.files import sync
from pipeline.receipts import hash_file
from sim.snapshots import Snapshot
from sim.world import FrameReport

REPORT = FrameReport(1, 1 / 60, {"water": 1}, {"water": 1 / 60}, {"water": {"mass": 1.0}})
GAP_S = 2e-3
"""A longer pause of the busy loop is one that it was made to wait."""


def snapshot(particles: int) -> Snapshot:
    """Positions without any order, which compress worst, and a smooth flow."""
    random = np.random.default_rng(1)
    position = random.random((particles, 3), dtype=np.float32)
    velocity = np.sin(5.0 * position) + 0.01 * random.random((particles, 3), dtype=np.float32)
    arrays = {
        "position": position,
        "velocity": velocity.astype(np.float32),
        "density": (1000.0 + random.random(particles)).astype(np.float32),
        "particle_id": np.arange(particles, dtype=np.int32),
    }
    return Snapshot("fluid", arrays, {"particle_radius": 0.01, "rest_density": 1000.0})


class BusyLoop:
    """A Python loop that counts, and notes when it was made to wait for the interpreter's lock."""

    def run(self, goes_on: Callable[[], bool]) -> None:
        self.count, self.waited_s, self.longest_s = 0, 0.0, 0.0
        began = last = time.perf_counter()
        while goes_on():
            for _ in range(1000):
                self.count += 1
            now = time.perf_counter()
            if now - last > GAP_S:
                self.waited_s += now - last
            self.longest_s = max(self.longest_s, now - last)
            last = now
        self.seconds = last - began

    @property
    def rate(self) -> float:
        return self.count / self.seconds


def alone(seconds: float) -> BusyLoop:
    loop, end = BusyLoop(), time.perf_counter() + seconds
    loop.run(lambda: time.perf_counter() < end)
    return loop


def beside(write: Callable[[], None]) -> BusyLoop:
    writer = threading.Thread(target=write)
    loop = BusyLoop()
    writer.start()
    loop.run(writer.is_alive)
    writer.join()
    return loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    bodies = {"water": snapshot(arguments.particles)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "frame.h5")

        def commit() -> None:
            write_frame(path, bodies, REPORT, device="cpu")
            validate_frame(path)
            hash_file(path)
            sync(path)

        rate = statistics.median(alone(0.5).rate for _ in range(arguments.repeats))
        commit()
        loops = [beside(commit) for _ in range(arguments.repeats)]
        result = {
            "particles": arguments.particles,
            "file_bytes": path.stat().st_size,
            "cores": len(os.sched_getaffinity(0)),
            "load_average": os.getloadavg()[0],
            "commit_s": statistics.median(loop.seconds for loop in loops),
            "busy_loop_keeps": statistics.median(loop.rate for loop in loops) / rate,
            "busy_loop_waited_s": max(loop.waited_s for loop in loops),
            "busy_loop_longest_wait_s": max(loop.longest_s for loop in loops),
        }
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
