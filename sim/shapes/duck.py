"""The procedural rubber duck: it swims along +x."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.modelling import (
    Distances,
    ellipsoid,
    mesh_parts,
    mirrored,
    round_cone,
    smooth_intersection,
    smooth_union,
)
from sim.shapes.solid import Points, TriangleMesh

_CELL = 0.026


def build_duck(length: float) -> MeshSolid:
    """The duck, `length` [m] from bill to tail, its bounding box centred on the origin."""
    mesh = _unit_mesh()
    return MeshSolid(mesh.transformed(length, np.eye(3), np.zeros(3)))


@lru_cache(maxsize=1)
def _unit_mesh() -> TriangleMesh:
    mesh = mesh_parts(_parts, (-1.6, -1.1, -0.8), (1.6, 1.1, 1.8), _CELL)
    lower, upper = mesh.bounds
    return mesh.transformed(1.0 / (upper - lower)[0], np.eye(3), -0.5 * (lower + upper) / (upper - lower)[0])


def _parts(points: Points) -> dict[str, Distances]:
    """Distances of its parts, in units of about half a body length."""
    pair = mirrored(points)

    body = ellipsoid(points, (-0.08, 0.0, 0.0), (0.98, 0.78, 0.60))
    body = smooth_union(body, ellipsoid(points, (0.40, 0.0, 0.08), (0.60, 0.66, 0.58)), 0.30)
    tail = round_cone(points, (-0.66, 0.0, 0.12), (-1.20, 0.0, 0.60), 0.34, 0.06)
    body = smooth_union(body, tail, 0.30)
    body = smooth_intersection(body, -(points[:, 2] + 0.51), 0.06)  # it stands on a flat base

    wing = ellipsoid(pair, (-0.14, 0.70, 0.14), (0.50, 0.15, 0.32), (-14.0, 14.0, 6.0))
    wing_tip = round_cone(pair, (-0.42, 0.76, 0.22), (-0.78, 0.78, 0.42), 0.15, 0.05)
    body = smooth_union(body, smooth_union(wing, wing_tip, 0.16), 0.05)

    head = ellipsoid(points, (0.50, 0.0, 1.02), (0.53, 0.50, 0.51))
    neck = round_cone(points, (0.46, 0.0, 0.30), (0.49, 0.0, 0.80), 0.46, 0.38)
    body = smooth_union(smooth_union(body, neck, 0.22), head, 0.12)

    upper_bill = ellipsoid(points, (1.04, 0.0, 0.97), (0.33, 0.27, 0.085), (0.0, -14.0, 0.0))
    lower_bill = ellipsoid(points, (0.98, 0.0, 0.84), (0.27, 0.21, 0.07), (0.0, 4.0, 0.0))
    bill = smooth_union(upper_bill, lower_bill, 0.04)

    eyes = ellipsoid(pair, (0.875, 0.27, 1.175), (0.075, 0.075, 0.10), (0.0, 0.0, 36.0))
    return {"body": body, "bill": bill, "eyes": eyes}
