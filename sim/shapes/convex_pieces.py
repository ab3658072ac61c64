"""Convex pieces of a mesh that is not convex, where a few of them are the mesh all but exactly."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim.shapes.assembly import manifold_of
from sim.shapes.cutting import hull_of
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.placement import PlacedSolid
from sim.shapes.solid import ShapeError

MOST_FACES, MOST_PLANES = 1000, 64
"""Of a mesh that is looked at, and of the planes that its faces lie in: what is round has more, and no few pieces."""
MOST_CONVEX = 32  # pieces; a mesh of more is as well off with distances
SAME_VOLUME = 0.005  # of the mesh: what pieces may cover besides it, and leave out of it
CONCAVITY = 0.02  # of a piece, at which it is cut no further; in units of the library


def convex_pieces(solid: MeshSolid) -> tuple[PlacedSolid, ...]:
    """Convex pieces (Wei, Liu, Ling & Su 2022, "Approximate convex decomposition for 3D meshes", CoACD); often none."""
    if len(solid.mesh.faces) > MOST_FACES or solid.cap_count or not solid.encloses_simply:
        return ()
    normals = solid.mesh.area_vectors / np.linalg.norm(solid.mesh.area_vectors, axis=1)[:, None]
    heights = np.einsum("fi,fi->f", normals, solid.mesh.corners[:, 0]) / np.ptp(solid.mesh.vertices)
    if len(np.unique(np.round(np.column_stack([normals, heights]), 4) + 0.0, axis=0)) > MOST_PLANES:
        return ()
    import coacd
    import manifold3d

    try:
        whole = manifold_of(solid.mesh, "mesh")
    except ShapeError:
        return ()
    coacd.set_log_level("error")
    mesh = coacd.Mesh(np.asarray(solid.mesh.vertices, np.float64), np.asarray(solid.mesh.faces, np.int32))
    found = coacd.run_coacd(mesh, threshold=CONCAVITY, max_convex_hull=-1, preprocess_mode="off", seed=0)
    hulls = [hull_of(np.asarray(vertices)) for vertices, _ in found]
    if not 1 < len(hulls) <= MOST_CONVEX:
        return ()
    made = [manifold_of(hull.shape.surface_mesh(None), "piece") for hull in hulls]
    union: Any = manifold3d.Manifold.batch_boolean(made, manifold3d.OpType.Add)
    differs = (union - whole).volume() + (whole - union).volume()
    return tuple(hulls) if differs <= SAME_VOLUME * whole.volume() else ()
