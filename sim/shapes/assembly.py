"""Meshes that several simpler solids stand for in contacts: compounds of shapes, and pieces of what was cut."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import CompoundShape
from sim.shapes.placement import PlacedSolid, build_solid
from sim.shapes.solid import ShapeError, TriangleMesh

BODY_PART = "body"
SAME_VOLUME = 1.0e-6  # of a body, by which the volumes of its parts may differ from its own


@dataclass(frozen=True, eq=False)
class Assembly(MeshSolid):
    """A closed mesh, and the solids that stand for it in contacts.

    Attributes:
        solids: they, in its frame.
        densities: of each solid [kg/m³], None for that of the body; None altogether where mass is that of the mesh.
    """

    solids: tuple[PlacedSolid, ...] = ()
    densities: tuple[float | None, ...] | None = None

    @property
    def encloses_simply(self) -> bool:
        """Surface integrals over the mesh are integrals over its inside: it was made by exact unions and cuts."""
        return True

    @property
    def parts_overlap(self) -> bool:
        """No surface is buried in the solid."""
        return False

    @cached_property
    def volume(self) -> float:
        """Volume [m³]: exact for round parts that do not overlap."""
        facets = 0.0
        if self.densities is not None:
            facets = sum(solid.volume - solid.surface_mesh().signed_volume for solid in self.solids)
        return self.mesh.signed_volume + facets


def build_compound(shape: CompoundShape) -> Assembly:
    """The union of some shapes. Raises as `build_solid`, and where a mesh among them cannot be united."""
    import manifold3d

    placed = tuple(build_solid(part) for part in shape.part)
    names = (BODY_PART, *dict.fromkeys(part.name for part in shape.part if part.name is not None))
    manifolds = [manifold_of(solid.surface_mesh(), f"shape.part[{number}]") for number, solid in enumerate(placed)]
    part_of = {
        manifold.original_id(): names.index(part.name or BODY_PART)
        for manifold, part in zip(manifolds, shape.part, strict=True)
    }
    union = manifold3d.Manifold.batch_boolean(manifolds, manifold3d.OpType.Add)
    mesh = mesh_of(union, part_of, names)
    warnings = tuple(warning for solid in placed for warning in solid.warnings)
    twice = sum(manifold.volume() for manifold in manifolds) - union.volume()
    if twice > SAME_VOLUME * union.volume():
        warnings = (*warnings, f"parts overlap by {twice:.3g} m³, which count twice in its mass; move them apart")
    densities = tuple(part.density for part in shape.part)
    return Assembly(mesh, warnings=warnings, solids=placed, densities=densities)


def manifold_of(mesh: TriangleMesh, label: str) -> Any:
    """A closed mesh as the library of unions and cuts has it. Raises ShapeError where it is none."""
    import manifold3d

    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    found = manifold3d.Manifold(manifold3d.Mesh64(vertices, np.ascontiguousarray(mesh.faces, dtype=np.uint64)))
    if found.status() != manifold3d.Error.NoError or found.volume() <= 0.0:
        raise ShapeError(
            f"{label}: its mesh is no simple closed surface ({found.status().name}), so that it can be neither united "
            "nor cut; rebuild it in a modelling program (Blender: Remesh modifier)"
        )
    return found.as_original()


def mesh_of(manifold: Any, part_of: dict[int, int], names: tuple[str, ...]) -> TriangleMesh:
    """The surface of a union or cut; `part_of` tells which part the faces of an original belong to."""
    found = manifold.to_mesh64()
    begins = np.asarray(found.run_index, dtype=np.int64) // 3
    parts = np.array([part_of[number] for number in found.run_original_id], dtype=np.int32)
    part = np.repeat(parts, np.diff(begins))
    vertices = np.array(found.vert_properties, dtype=np.float64)[:, :3]
    return TriangleMesh(vertices, np.array(found.tri_verts, dtype=np.int32), part, names)
