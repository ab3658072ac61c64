"""Mesh files in a job: wherever a shape of one stands."""

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import FileShape


def mesh_shapes(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, FileShape]]:
    """Every mesh, still or animated, below a table of the job, with the path of its shape, in the order of the keys."""
    if isinstance(value, FileShape):
        yield path, value
    elif isinstance(value, BaseModel):
        for key in type(value).model_fields:
            yield from mesh_shapes(getattr(value, key), (*path, key))
    elif isinstance(value, tuple):
        for index, child in enumerate(value):
            yield from mesh_shapes(child, (*path, index))


def with_written(job: Job, path: KeyPath, new: object) -> Job:
    """A job with another value at a place of its file, for all bodies that the table there makes; none is validated."""
    if path[:1] != ("rigid",):
        result: Job = with_value(job, path, new)
        return result

    def changed(body: RigidBodyParameters) -> Any:
        is_of_whole = body.whole is not None and path[2:3] == ("shape",)
        return with_value(body, ("shape", "of", *path[3:]) if is_of_whole else path[2:], new)

    bodies = tuple(changed(body) if body.table == path[1] else body for body in job.rigid)
    return job.model_copy(update={"rigid": bodies})


def with_value(value: Any, path: KeyPath, new: object) -> Any:
    """A model, tuple or table with another value at a path; nothing is validated."""
    if not path:
        return new
    key, rest = path[0], path[1:]
    if isinstance(value, BaseModel):
        return value.model_copy(update={str(key): with_value(getattr(value, str(key)), rest, new)})
    if isinstance(value, tuple):
        return tuple(with_value(each, rest, new) if index == key else each for index, each in enumerate(value))
    return {**value, key: with_value(value[key], rest, new)}
