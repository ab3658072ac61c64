"""That the memory which a job's check counts for smoke is not less than what a simulation of it takes."""

import math

from smoke_scenes import Bytes

from pipeline.kinds.checks.smoke import BYTES_PER_CELL, BYTES_PER_CELL_ON_GPU, FIRE_BYTES, FIRE_BYTES_ON_GPU
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
            "source": [
                {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.2), "temperature": 700, "fuel": 1}
            ],
            "fire": {},
        }
    ],
    "rigid": [
        {
            **{"name": "ball", "kind": "dynamic", "density": 100.0, "shape": {"type": "sphere", "radius": 0.15}},
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


def test_check_counts_all_that_smoke_with_everything_in_it_takes(monkeypatch):
    initialize("cpu")
    job = Job.model_validate(JOB, strict=False)
    # Rows of turbulence have half a node a cell, each of five numbers.
    made = Bytes(monkeypatch, least_values=CELLS**3)
    world = build_world(job, frames_per_second=24)
    cells = CELLS**3
    solver = made.total / cells
    # Counted alone: the couplings to a fluid and to cloth, of 32 and 24 bytes, are there.
    assert solver > 140.0
    assert solver <= BYTES_PER_CELL_ON_GPU + FIRE_BYTES_ON_GPU
    snapshot = sum(array.nbytes for array in world.snapshots()["fog"].arrays.values())
    checkpoint = sum(array.nbytes for name, array in world.checkpoint().items() if math.prod(array.shape) >= cells)
    assert max(snapshot, checkpoint) <= SMOKE.snapshot_bytes[0] * cells
    assert solver + simulate.SNAPSHOTS_AT_ONCE * SMOKE.snapshot_bytes[0] <= BYTES_PER_CELL + FIRE_BYTES
