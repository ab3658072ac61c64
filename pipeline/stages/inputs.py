"""Inputs of stages beside artifacts: Blender's version, and bodies with mesh files named by their content."""

from functools import cache
from typing import TypeVar

from pydantic import BaseModel

from pipeline.base.content import content_name, tool_version
from pipeline.base.errors import StageUnavailableError
from pipeline.model.meshes import mesh_shapes, with_value
from render.blender import BlenderUnavailableError, require_supported_executable

M = TypeVar("M", bound=BaseModel)


@cache
def blender_version(executable: str | None) -> str:
    """Version of the Blender that draws; wherever it lies, the same version gives the same frames.

    Raises StageUnavailableError: the executable is not there, or not a Blender that can be used.
    """
    if executable is None:
        return tool_version("bpy")
    try:
        return ".".join(map(str, require_supported_executable(executable)))
    except BlenderUnavailableError as error:
        raise StageUnavailableError(f"render: {error}") from error


def by_content(table: M) -> M:
    """A table of the job with its mesh files named by what is in them: where they lie has no effect.

    Raises MissingInputError: a file cannot be read.
    """
    for path, shape in mesh_shapes(table):
        table = with_value(table, (*path, "file"), content_name(shape.file, "mesh"))
    return table
