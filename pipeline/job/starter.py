"""Commented job files to start from."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from pipeline.base.errors import JobFileError
from pipeline.model.job import NAME_PATTERN

_HEAD = """\
# Editors complete and check this file after `pipeline schema > job.schema.json` and a first line
# "#:schema job.schema.json" here. Lengths are in metres, z points up; docs/guide/job-file.md lists every key.
#
#     pipeline check {file}      says what is wrong, and how large the job is
#     pipeline submit {file} --preview
#     pipeline submit {file}

name = "{name}"              # also the folder of its results, renders/{name}/
duration = {duration}                  # [s]; or: frames = 120
fps = 60
"""

_PICTURE = """
[set]
name = "studio"                 # or "outdoor"

[render]
resolution = [960, 540]         # even numbers
quality = "preview"             # draft, preview or final

[camera]
framing = "action"              # closest to all that happens; "domain" shows pictures while it still simulates
# position = [1.6, -1.8, 1.0]   # or, instead of framing: where it stands
# look_at = [0.0, 0.0, 0.2]
# focal_length_mm = 50.0
"""

_DAM_BREAK = """
[domain]                        # walls on every side but open_faces
min = [-0.5, -0.15, 0.0]
max = [0.5, 0.15, 0.5]
open_faces = ["z+"]

[[fluid]]
name = "water"
particle_radius = 0.0075        # half of it: eight times the particles, and finer waves
viscosity = 1.0e-6              # [m²/s]

[[fluid.block]]                 # a column of water against the left wall
shape = { type = "box", size = [0.3, 0.3, 0.3] }
position = [-0.35, 0.0, 0.15]

[[rigid]]                       # an obstacle in its way
name = "pillar"
shape = { type = "box", size = [0.08, 0.08, 0.3] }
position = [0.15, 0.0, 0.15]

[material.water]
look = "water"

[material.pillar]
look = "stone"
"""

_DROP = """
[domain]
min = [-0.25, -0.25, 0.0]
max = [0.25, 0.25, 0.6]
open_faces = ["z+"]

[[rigid]]
name = "duck"
shape = { type = "duck", length = 0.24 }
# shape = { type = "mesh", file = "duck.obj", up = "y", size = 0.24 }    # OBJ, PLY, STL or GLB
position = [0.0, 0.0, 0.1]

[[fluid]]
name = "water"
particle_radius = 0.006         # half of it: eight times the particles, and finer splashes

[[fluid.block]]                 # a ball of water falling onto the duck
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.42]
velocity = [0.0, 0.0, -1.0]

[material.duck]
look = "rubber"
color = [0.95, 0.65, 0.03]
"""

_SMOKE = """
[domain]
min = [-0.4, -0.4, 0.0]
max = [0.4, 0.4, 1.2]

[[smoke]]
name = "plume"
cell_size = 0.0125              # half of it: eight times the cells, and finer eddies
vorticity_confinement = 0.2     # more curl
cooling = 0.2                   # [1/s]

[[smoke.source]]
shape = { type = "cylinder", radius = 0.08, height = 0.06 }
position = [0.0, 0.0, 0.08]
temperature = 350.0             # [K], in air of 293 K
velocity = [0.0, 0.0, 0.5]

[[rigid]]                       # the plume parts around it
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.03, 0.0, 0.5]

[material.plume]
look = "smoke"

[material.ball]
look = "ceramic"
"""

_CLOTH = """
[domain]
min = [-0.6, -0.6, 0.0]
max = [0.6, 0.6, 1.0]
open_faces = ["x-", "x+", "y-", "y+", "z+"]     # a floor, and no walls

[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.2 }
position = [0.0, 0.0, 0.3]
friction = 0.4

[[cloth]]                       # falls onto the ball and drapes over it
name = "sheet"
material = "cotton"             # or silk, denim, rubber
shape = { type = "rectangle", size = [0.9, 0.9], resolution = 0.01 }    # half of it: four times the nodes, finer folds
position = [0.0, 0.0, 0.6]
rotation_deg = [0.0, 0.0, 20.0]
thickness = 1.0e-3

# [[cloth.pin]]                 # holds a corner, until it is let go
# corner = "x-y-"
# release_s = 0.5

[material.sheet]
look = "cotton"
color = [0.09, 0.20, 0.36]
"""

_SCENES: Mapping[str, tuple[str, str]] = {
    "dam-break": ("2.0", _DAM_BREAK),
    "drop": ("1.5", _DROP),
    "smoke": ("3.0", _SMOKE),
    "cloth": ("2.0", _CLOTH),
}
TEMPLATES = tuple(_SCENES)


def starter(name: str, template: str, *, file: str) -> str:
    """The text of a job file that passes every check.

    Args:
        name: the job's name.
        template: one of `TEMPLATES`.
        file: how the file is called in the commands that it shows.
    """
    duration, scene = _SCENES[template]
    return _HEAD.format(name=name, file=file, duration=duration) + scene + _PICTURE


def write_starter(target: Path, template: str) -> Path:
    """Write a starter to `target`, `.toml` added where it is missing. The job is named after the file.

    Raises:
        JobFileError: the name is none for a job, the file exists, or it cannot be written.
    """
    path = target if target.suffix == ".toml" else target.with_name(f"{target.name}.toml")
    name = path.stem
    if not re.fullmatch(NAME_PATTERN, name):
        rule = 'a name holds letters, digits, ".", "_" and "-", and begins with a letter or digit'
        raise JobFileError([f'"{name}": {rule}'])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(starter(name, template, file=str(path)))
    except FileExistsError:
        raise JobFileError([f"{path}: exists already; choose another name"]) from None
    except OSError as error:
        raise JobFileError([f"{path}: cannot be written: {error.strerror}"]) from None
    return path
