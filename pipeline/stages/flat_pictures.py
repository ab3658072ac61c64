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


def warn_of_flat_pictures(context: TaskContext) -> None:
    """Warn of them at the film's first frame.

    Args:
        context: of a frame's task, whose inputs are there.

    Raises:
        BlenderUnavailableError: Blender does not answer.
        InvalidFileError: a .blend file cannot be read.
    """
    from render.blend_file import has_pictures_by_uv

    if context.task.frame != 0:
        return
    job = context.job
    for name, material in _without_coordinates(job, context.layout):
        if material.blend is None:
            continue
        file, inside = split_blend(material.blend)
        if has_pictures_by_uv(Path(file), inside, job.render.blender):
            context.warn(
                FLAT_PICTURES,
                f'"{name}" has no texture coordinates, so pictures in its material "{inside}" show one colour; give it '
                "a mesh file with a UV map, or let the material use generated or object coordinates",
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
