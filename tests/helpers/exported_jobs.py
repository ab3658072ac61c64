"""A small job with a body of every kind, simulated once, and its exports."""

from pathlib import Path

from films import JOB, Studio

FRAMES = 4
EVERYTHING = (
    JOB.replace("frames = 6", f"frames = {FRAMES}")
    .replace('name = "ball"\n', 'name = "ball"\nkind = "dynamic"\ndensity = 600.0\n')
    .replace("resolution = [64, 36]", "resolution = [96, 54]")
    .replace("samples = 2", "samples = 16")
    + """
[[rigid]]
name = "duck"
shape = { type = "duck", length = 0.12 }
position = [-0.2, -0.18, 0.06]

[[embers]]
name = "sparks"
smoke = "plume"

[[embers.source]]
shape = { type = "sphere", radius = 0.05 }
position = [0.0, 0.0, 0.2]
rate = 600.0

[camera]
position = [0.7, -1.2, 0.7]
"""
)


def simulated(folder: Path) -> Studio:
    """A studio whose job is simulated, and nothing is drawn."""
    studio = Studio.open(folder, EVERYTHING)
    studio.submit(
        "--until", "surface", "--until", "cloth", "--until", "volume", "--until", "whitewater", "--until", "embers"
    )
    return studio
