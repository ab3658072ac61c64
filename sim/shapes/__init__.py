"""Shapes: primitives, the procedural duck and bunny, meshes, and their signed distances.

Importing this package loads neither trimesh nor libigl; the names below load their modules on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.shapes.level_set import LevelSet
    from sim.shapes.placement import PlacedSolid, build_solid
    from sim.shapes.sampling import fill_with_particles, sample_surface
    from sim.shapes.solid import ShapeError, Solid, TriangleMesh

__all__ = [
    "LevelSet",
    "PlacedSolid",
    "ShapeError",
    "Solid",
    "TriangleMesh",
    "build_solid",
    "fill_with_particles",
    "sample_surface",
]

_HOME = {
    "LevelSet": "level_set",
    "PlacedSolid": "placement",
    "build_solid": "placement",
    "fill_with_particles": "sampling",
    "sample_surface": "sampling",
    "ShapeError": "solid",
    "Solid": "solid",
    "TriangleMesh": "solid",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
