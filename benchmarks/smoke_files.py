"""Size, time and memory of a frame of smoke on its way from the solver to Blender; JSON on the standard output.

python benchmarks/smoke_files.py --cells 256
python benchmarks/smoke_files.py --cells 128 --full

The plume is made of noise of all sizes down to two cells, with the amplitudes of turbulence. Times are processor times,
the smallest of a few; the stage's memory is that of a process that does nothing else.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from scipy.ndimage import zoom

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.cache import read_smoke_in_box, validate_frame, write_frame
from render.parameters import VolumeParameters
from render.volume import import_openvdb, validate_volume, write_volume
from sim.snapshots import Snapshot
from sim.world import FrameReport

FPS, SHUTTER, AMBIENT = 60.0, 0.5, 293.0
REPORT = FrameReport(1, 1 / FPS, {"plume": 1}, {"plume": 1 / FPS}, {"plume": {"mass": 1.0}})
COARSEST = 4
"""Cells of the coarsest noise along an edge."""


def turbulence(cells: int, random: np.random.Generator) -> np.ndarray:
    """Noise of zero mean and unit variance at the largest size; amplitudes fall as the cube root of the size."""
    total = np.zeros((cells,) * 3, np.float32)
    size = COARSEST
    while size <= cells // 2:
        lattice = random.standard_normal((size,) * 3).astype(np.float32)
        total += np.float32((COARSEST / size) ** (1 / 3)) * zoom(
            lattice, cells / size, order=1, grid_mode=True, mode="grid-wrap"
        )
        size *= 2
    return total


def plume(cells: int, *, full: bool) -> Snapshot:
    """A plume that opens upwards in a box of 1 m, or smoke all through it."""
    random = np.random.default_rng(1)
    x, y, z = np.meshgrid(*(((np.arange(cells) + 0.5) / cells).astype(np.float32),) * 3, indexing="ij", sparse=True)
    radius = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2) / (0.05 + 0.2 * z)
    shape = np.ones_like(radius) if full else np.clip(1.5 - radius, 0.0, 1.0)
    density = np.clip(shape * (0.5 + 0.2 * turbulence(cells, random)), 1.0e-3 if full else 0.0, 1.0)
    velocity = np.stack([0.5 * turbulence(cells, random) for _ in range(3)], axis=-1)
    velocity[..., 2] += 2.0 * np.exp(-(radius**2))
    temperature = np.float32(AMBIENT) + np.float32(150.0) * density
    attributes = {"origin": (0.0, 0.0, 0.0), "cell_size": 1.0 / cells, "ambient_temperature": AMBIENT}
    return Snapshot("smoke", {"density": density, "temperature": temperature, "velocity": velocity}, attributes)


def least_time(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def run_stage(cached: Path, volume: Path) -> None:
    """What the stage does with a cached frame."""
    smoke = read_smoke_in_box(cached, "plume")
    write_volume(volume, **vars(smoke), parameters=VolumeParameters(), fps=FPS, shutter=SHUTTER)
    validate_volume(volume)


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def in_its_own_process(cached: Path, volume: Path, repeats: int) -> None:
    import_openvdb()
    before = psutil.Process().memory_info().rss
    run_stage(cached, volume)
    grown = peak_bytes() - before
    json.dump({"stage_s": least_time(lambda: run_stage(cached, volume), repeats), "stage_bytes": grown}, sys.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=256)
    parser.add_argument("--full", action="store_true", help="smoke in every cell")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--stage", nargs=2, type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.stage:
        in_its_own_process(*arguments.stage, arguments.repeats)
        return
    smoke = plume(arguments.cells, full=arguments.full)
    with tempfile.TemporaryDirectory() as folder:
        cached, whole, volume = (Path(folder, name) for name in ("frame.h5", "whole.h5", "frame.vdb"))

        def write(path: Path, longest_shutter_s: float | None) -> None:
            write_frame(path, {"plume": smoke}, REPORT, device="cpu", longest_shutter_s=longest_shutter_s)

        result = {
            "cells": arguments.cells**3,
            "smoke_share": float((smoke.arrays["density"] > 0).mean()),
            "snapshot_bytes": sum(array.nbytes for array in smoke.arrays.values()),
            "write_as_it_is_s": least_time(lambda: write(whole, None), 1),
            "write_s": least_time(lambda: write(cached, 1 / FPS), arguments.repeats),
            "validate_s": least_time(lambda: validate_frame(cached), arguments.repeats),
            "as_it_is_bytes": whole.stat().st_size,
            "cache_bytes": cached.stat().st_size,
        }
        alone = [sys.executable, __file__, "--stage", str(cached), str(volume), "--repeats", str(arguments.repeats)]
        result |= json.loads(subprocess.run(alone, check=True, capture_output=True, text=True).stdout)
        result["stage_bytes_per_cell"] = result["stage_bytes"] / result["cells"]
        result["vdb_bytes"] = volume.stat().st_size
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
