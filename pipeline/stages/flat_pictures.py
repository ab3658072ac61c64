"""Pictures of .blend materials on what has no texture coordinates, all of which takes one colour of the picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pipeline.job.input_files import split_blend
from pipeline.job.looks import BODY, parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.base import TaskContext
from render.parameters import MaterialParameters

FLAT_PICTURES = "flat pictures"
UNKNOWN_PICTURES = "unknown pictures"


def warn_of_flat_pictures(context: TaskContext) -> None:
    """Warn of them, and of materials that cannot be looked at, at the film's first frame.

    Blender is asked once for each material, whatever has it.

    Args:
        context: of a frame's task, whose inputs are there.
    """
    from render.blend_file import has_pictures_by_uv
    from render.blender import BlenderUnavailableError
    from render.errors import InvalidFileError

    if context.task.frame != 0:
        return
    job = context.job
    names: dict[str, list[str]] = {}
    for name, material in _without_coordinates(job, context.layout):
        if material.blend is not None:
            names.setdefault(material.blend, []).append(name)
    for blend, bare in names.items():
        file, inside = split_blend(blend)
        try:
            is_flat = has_pictures_by_uv(Path(file), inside, job.render.blender)
        except (BlenderUnavailableError, InvalidFileError) as error:  # if the frame cannot be drawn, its drawing tells
            having = ", ".join(f'"{name}"' for name in bare)
            context.warn(
                UNKNOWN_PICTURES,
                f'the material "{inside}" of {having} could not be looked at ({error}); if it has pictures, '
                "they may show one colour, as there are no texture coordinates",
            )
            continue
        if is_flat:
            for name in bare:
                context.warn(
                    FLAT_PICTURES,
                    f'"{name}" has no texture coordinates, so pictures in its material "{inside}" show one colour; '
                    "give it a mesh file with a UV map, or let the material use generated or object coordinates",
                )


def _without_coordinates(job: Job, layout: JobLayout) -> Iterator[tuple[str, MaterialParameters]]:
    """What has no texture coordinates, by the names of objects, with its material."""
    from render.meshes import read_ply

    for body in job.rigid:
        for part in parts_of(body.shape.type):
            material = job.material_of(body.name, part)
            mesh = layout.path(layout.body_mesh(body.name, part))
            if material.blend is not None and read_ply(mesh).corner_uv is None:
                yield body.name if part == BODY else f"{body.name}.{part}", material
    for fluid in job.fluid:
        yield fluid.name, job.material_of(fluid.name)
