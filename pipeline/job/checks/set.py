"""What a valid job may have wrong about the set that it is drawn on, and about materials of .blend files."""

from pathlib import Path

from blender_scripts.look_table import looks_for
from pipeline.job.input_files import split_blend
from pipeline.kinds.base import Kind
from pipeline.kinds.checks.shapes import file_exists
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, quoted_list
from render.backplate import read_backplate_size
from render.environment import read_environment_size
from render.errors import InvalidFileError
from render.parameters import MaterialParameters

# A picture of the whole sphere is 360 degrees wide and 180 high.
_SPHERE_ASPECT = 2.0

LEAST_SHOWN = 0.9
"""Share of a backplate that is shown without a word."""


def check_set(job: Job, findings: Findings) -> None:
    """Note what is wrong with ground, background and the picture around the scene."""
    parameters, given = job.set, job.set.model_fields_set
    if parameters.hdri is not None:
        _check_hdri(parameters.hdri, findings)
        if "name" in given:
            findings.warn(("set", "name"), "has no effect beside hdri, which light and sky come from; remove one")
    elif "rotation_deg" in given:
        findings.warn(("set", "rotation_deg"), "has no effect without hdri, which it turns")
    for key in sorted({"sun_elevation_deg", "sun_azimuth_deg"} & given):
        if parameters.hdri is not None:
            findings.error(("set", key), "has no effect beside hdri, which all light comes from; remove one")
        elif parameters.name != "outdoor":
            findings.error(
                ("set", key), f'has no effect on the set "{parameters.name}", which has no sun; set name = "outdoor"'
            )
    if parameters.tank and not job.has_panes:
        findings.warn(("set", "tank"), "has no effect, as all sides of the domain are open: there is no pane")
    if parameters.backplate is not None:
        _check_backplate(job, Path(parameters.backplate), findings)
    if not parameters.is_seen and parameters.ground is not None:
        other = "backplate" if parameters.backplate is not None else f'background = "{parameters.background}"'
        findings.warn(("set", "ground"), f"is seen in reflections only, as {other} leaves it out")
    if job.render.format == "png16" and (parameters.background == "plain" or parameters.backplate is not None):
        key, what = ("background", 'is "plain", which') if parameters.backplate is None else ("backplate", "is what")
        findings.error(
            ("set", key), f'{what} pictures are laid over in 8 bits, but render.format is "png16"; take "png"'
        )


def check_blend(material: MaterialParameters, path: KeyPath, kind: Kind | None, findings: Findings) -> None:
    """Note what is wrong with a material that comes from a .blend file, on a body of a kind, if there is one."""
    assert material.blend is not None
    file_exists(split_blend(material.blend)[0], ".blend file", (*path, "blend"), findings)
    if kind is not None and kind.wears == "smoke":
        looks = quoted_list(looks_for(kind.wears))
        findings.error((*path, "blend"), f"is for surfaces; {kind.name} can only look like {looks}")
    check_keys_beside_blend(material, path, findings)


def check_keys_beside_blend(material: MaterialParameters, path: KeyPath, findings: Findings) -> None:
    """Note keys that change nothing, as the body or the part has a material of a .blend file."""
    for key in sorted(material.model_fields_set - {"blend"}):
        findings.warn((*path, key), "has no effect beside blend, whose material says all")


def _check_hdri(name: str, findings: Findings) -> None:
    key = ("set", "hdri")
    if not file_exists(name, "picture", key, findings):
        return
    try:
        width, height = read_environment_size(Path(name))
    except InvalidFileError as error:
        findings.error(key, str(error))
    except OSError as error:
        findings.error(key, f"cannot read {name}: {error.strerror}")
    else:
        if width != _SPHERE_ASPECT * height:
            findings.warn(key, f"is {width} x {height} pixels; a picture of the whole sphere is twice as wide as high")


def _check_backplate(job: Job, path: Path, findings: Findings) -> None:
    key = ("set", "backplate")
    if not file_exists(str(path), "picture", key, findings):
        return
    try:
        width, height = read_backplate_size(path)
    except InvalidFileError as error:
        findings.error(key, str(error))
        return
    except OSError as error:
        findings.error(key, f"cannot read {path}: {error.strerror}")
        return
    columns, rows = job.render.resolution
    shown = min(width / columns, height / rows) ** 2 * columns * rows / (width * height)
    if shown < LEAST_SHOWN:
        findings.warn(
            key,
            f"is {width} x {height} pixels; {100.0 * (1.0 - shown):.0f} % of it is cut off to fill {columns} x {rows}",
        )
    if job.camera.moves:
        findings.warn(key, "stands still behind a camera that moves")
