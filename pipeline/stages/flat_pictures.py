"""Pictures of .blend materials on what has no texture coordinates, all of which takes one colour of the picture."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from pipeline.base.layout import JobLayout
from pipeline.job.input_files import split_blend
from pipeline.kinds.table import material_of
from pipeline.model.job import Job
from pipeline.model.looks import BODY, parts_of
from pipeline.stages.base import TaskContext

FLAT_PICTURES = "flat pictures"


def warn_of_flat_pictures(context: TaskContext, pictures_by_uv: Collection[str]) -> None:
    """Warn of them at the film's first frame.

    Args:
        context: of a frame's task, whose inputs are there.
        pictures_by_uv: names of objects with pictures that lie by texture coordinates, as the renderer found them.
    """
    if context.task.frame != 0:
        return
    for name, blend in _without_coordinates(context.job, context.layout):
        if name in pictures_by_uv:
            context.warn(
                FLAT_PICTURES,
                f'"{name}" has no texture coordinates, so pictures in its material "{split_blend(blend)[1]}" show one '
                "colour; give it a mesh file with a UV map, or let the material use generated or object coordinates",
            )


def _without_coordinates(job: Job, layout: JobLayout) -> Iterator[tuple[str, str]]:
    """Objects with a .blend material and no texture coordinates: their names, and `file.blend:Name`."""
    from render.meshes import read_ply

    for body in job.rigid:
        for part in parts_of(body.shape.type):
            material = material_of(job, body.name, part)
            mesh = layout.path(layout.body_mesh(body.name, part))
            if material.blend is not None and read_ply(mesh).corner_uv is None:
                yield body.name if part == BODY else f"{body.name}.{part}", material.blend
    for fluid in job.fluid:
        if (blend := material_of(job, fluid.name).blend) is not None:
            yield fluid.name, blend
