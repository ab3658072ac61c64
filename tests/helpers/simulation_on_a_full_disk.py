"""Run a job's simulation until the disk is full, free some room, and run it again; prints what became of it as JSON.

PYTHONPATH=.:tests python simulation_on_a_full_disk.py FOLDER BALLAST
"""

import json
import sys
from pathlib import Path

import killed_simulation

from pipeline.base.layout import JobLayout
from pipeline.run.events import Failed
from pipeline.store.receipts import is_committed

FRAMES = 12

JOB = f"""
name = "drop"
frames = {FRAMES}
device = "cpu"

[[fluid]]
name = "water"
particle_radius = 0.03
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
position = [0.0, 0.0, 0.3]
"""


def committed(layout: JobLayout) -> list[int]:
    return [frame for frame in range(FRAMES) if is_committed(layout, layout.frame_cache(frame), "f")]


def main(folder: Path, ballast: Path) -> None:
    """See the module."""
    layout = JobLayout(folder)
    layout.root.mkdir()
    layout.job_file.write_text(JOB)
    first = killed_simulation.simulate(layout)
    told = {
        "kind": first.kind.value if isinstance(first, Failed) else None,
        "message": first.message if isinstance(first, Failed) else "",
        "committed": committed(layout),
        "parts": [path.name for path in layout.root.rglob("*.part.*")],
        "checkpoints": [path.name for path in layout.checkpoints.glob("*")],
    }
    ballast.unlink()
    second = killed_simulation.simulate(layout, attempt=2)
    told |= {"second": type(second).__name__, "committed_then": committed(layout)}
    sys.stdout.write(json.dumps(told) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
