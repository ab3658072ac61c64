"""Mesh files in a job: wherever a shape of one stands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from pydantic import BaseModel

from pipeline.model.positions import KeyPath
from sim.shapes.parameters import MeshShape

M = TypeVar("M", bound=BaseModel)


def mesh_shapes(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, MeshShape]]:
    """Every mesh below a table of the job, with the path of its shape, in the order of the keys."""
    if isinstance(value, MeshShape):
        yield path, value
    elif isinstance(value, BaseModel):
        for key in type(value).model_fields:
            yield from mesh_shapes(getattr(value, key), (*path, key))
    elif isinstance(value, tuple):
        for index, child in enumerate(value):
            yield from mesh_shapes(child, (*path, index))


def with_meshes(model: M, replaced: Callable[[MeshShape], MeshShape]) -> M:
    """A copy of a table with each mesh below it replaced; the table itself if there is none."""
    changes: dict[str, Any] = {}
    for key in type(model).model_fields:
        before = getattr(model, key)
        after = _replaced(before, replaced)
        if after is not before:
            changes[key] = after
    return model.model_copy(update=changes) if changes else model


def _replaced(value: Any, replaced: Callable[[MeshShape], MeshShape]) -> Any:
    if isinstance(value, MeshShape):
        return replaced(value)
    if isinstance(value, BaseModel):
        return with_meshes(value, replaced)
    if isinstance(value, tuple):
        children = tuple(_replaced(child, replaced) for child in value)
        return children if any(a is not b for a, b in zip(children, value, strict=True)) else value
    return value
