"""That the memory which a job's check counts for smoke is not less than what a simulation of it takes."""

import math

import numpy as np
import taichi as ti

from pipeline.kinds.checks.smoke import BYTES_PER_CELL, BYTES_PER_CELL_ON_GPU
from pipeline.kinds.smoke import SMOKE
from pipeline.model.job import Job
from pipeline.stages import simulate
from sim.build import build_world
from sim.core.runtime import initialize

CELLS = 64
JOB = {
    "name": "all",
    "frames": 2,
    "smoke": [
        {
            **{"name": "fog", "cell_size": 1.0 / CELLS, "min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0)},
            # The smallest eddies take the most.
            "turbulence": {"strength": 1.0, "size": 2.0 / CELLS},
            "source": [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.2)}],
        }
    ],
    "rigid": [
        {
            **{"name": "ball", "kind": "kinematic", "shape": {"type": "sphere", "radius": 0.15}},
            **{"position": (0.0, 0.0, 0.6), "velocity": (0.1, 0.0, 0.0)},
        }
    ],
    "fluid": [
        {
            **{"name": "water", "particle_radius": 0.04},
            "block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "position": (0.3, 0.3, 0.1)}],
        }
    ],
    "cloth": [
        {
            **{"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (9, 9)}},
            "position": (-0.3, 0.0, 0.5),
        }
    ],
}


def count_bytes_of_cells(monkeypatch) -> list[int]:
    """Has the fields of at least a value a cell that are made from now on leave their sizes in a list [bytes]."""
    sizes: list[int] = []
    make, make_vectors = ti.field, ti.Vector.field

    def note(dtype, shape, count):
        values = int(np.prod(shape))
        # Rows of turbulence have half a node a cell, each of five numbers.
        if values * count >= CELLS**3:
            sizes.append(values * count * (8 if dtype in (ti.i64, ti.u64, ti.f64) else 4))

    def field(dtype, shape):
        note(dtype, shape, 1)
        return make(dtype, shape=shape)

    def vectors(count, dtype, shape):
        note(dtype, shape, count)
        return make_vectors(count, dtype, shape=shape)

    monkeypatch.setattr(ti, "field", field)
    monkeypatch.setattr(ti.Vector, "field", vectors)
    return sizes


def test_check_counts_all_that_smoke_with_everything_in_it_takes(monkeypatch):
    initialize("cpu")
    job = Job.model_validate(JOB, strict=False)
    sizes = count_bytes_of_cells(monkeypatch)
    world = build_world(job, frames_per_second=24)
    cells = CELLS**3
    solver = sum(sizes) / cells
    # Counted alone: the couplings to a fluid and to cloth, of 32 and 24 bytes, are there.
    assert solver > 140.0
    assert solver <= BYTES_PER_CELL_ON_GPU
    snapshot = sum(array.nbytes for array in world.snapshots()["fog"].arrays.values())
    checkpoint = sum(array.nbytes for name, array in world.checkpoint().items() if math.prod(array.shape) >= cells)
    assert max(snapshot, checkpoint) <= SMOKE.snapshot_bytes[0] * cells
    assert solver + simulate.SNAPSHOTS_AT_ONCE * SMOKE.snapshot_bytes[0] <= BYTES_PER_CELL
