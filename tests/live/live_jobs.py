"""Small scenes to play with."""

from pathlib import Path

from pipeline.job.loading import LoadedJob, read_job

BALL_OVER_SHEET = """\
name = "drape"
# what nobody may lose: a remark
[domain]
open_faces = ["x-", "x+", "y-", "y+", "z+"]

[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = { type = "sphere", radius = 0.08 }
position = [0.0, 0.0, 0.62]

[[rigid]]
name = "post"
shape = { type = "box", size = [0.05, 0.05, 0.1] }
position = [0.4, 0.0, 0.05]

[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [0.4, 0.4], counts = [17, 17] }
position = [0.0, 0.0, 0.5]
stretch_stiffness = 500.0   # soft
thickness = 4e-3
substeps = 8
[[cloth.pin]]
edge = "y-"
[[cloth.pin]]
edge = "y+"
"""


def loaded(folder: Path, text: str = BALL_OVER_SHEET) -> LoadedJob:
    path = folder / "drape.toml"
    path.write_text(text)
    return read_job(path)
