"""The procedural bunny: it sits on its base and looks along +x."""

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
    smooth_difference,
    smooth_intersection,
    smooth_union,
)
from sim.shapes.solid import Points, TriangleMesh

_CELL = 0.026


def build_bunny(height: float) -> MeshSolid:
    """The bunny, `height` [m] from base to ears, its bounding box centred on the origin."""
    mesh = _unit_mesh()
    return MeshSolid(mesh.transformed(height, np.eye(3), np.zeros(3)))


@lru_cache(maxsize=1)
def _unit_mesh() -> TriangleMesh:
    mesh = mesh_parts(_parts, (-1.3, -1.0, -0.1), (1.3, 1.0, 3.0), _CELL)
    lower, upper = mesh.bounds
    return mesh.transformed(1.0 / (upper - lower)[2], np.eye(3), -0.5 * (lower + upper) / (upper - lower)[2])


def _parts(points: Points) -> dict[str, Distances]:
    """Distances of its parts, in units of about a body's height."""
    pair = mirrored(points)

    body = ellipsoid(points, (-0.18, 0.0, 0.60), (0.70, 0.58, 0.62), (0.0, -12.0, 0.0))
    body = smooth_union(body, ellipsoid(points, (0.26, 0.0, 0.80), (0.40, 0.40, 0.56)), 0.30)
    haunch = ellipsoid(pair, (-0.14, 0.44, 0.42), (0.46, 0.24, 0.42))
    body = smooth_union(body, haunch, 0.06)
    hind_foot = ellipsoid(pair, (0.26, 0.50, 0.10), (0.40, 0.16, 0.13))
    body = smooth_union(body, hind_foot, 0.05)
    front_leg = round_cone(pair, (0.44, 0.19, 0.66), (0.56, 0.19, 0.14), 0.19, 0.12)
    paw = ellipsoid(pair, (0.64, 0.19, 0.10), (0.20, 0.135, 0.12))
    body = smooth_union(body, smooth_union(front_leg, paw, 0.08), 0.07)

    head = ellipsoid(points, (0.42, 0.0, 1.46), (0.46, 0.41, 0.40), (0.0, 10.0, 0.0))
    snout = ellipsoid(points, (0.76, 0.0, 1.33), (0.19, 0.19, 0.17))
    cheek = ellipsoid(pair, (0.62, 0.19, 1.29), (0.20, 0.18, 0.16))
    head = smooth_union(smooth_union(head, snout, 0.16), cheek, 0.10)
    ear = ellipsoid(pair, (0.16, 0.24, 2.20), (0.125, 0.19, 0.62), (-9.0, -12.0, 12.0))
    hollow = ellipsoid(pair, (0.30, 0.265, 2.20), (0.11, 0.12, 0.47), (-9.0, -12.0, 12.0))
    head = smooth_union(head, smooth_difference(ear, hollow, 0.05), 0.08)
    body = smooth_union(body, head, 0.12)
    body = smooth_intersection(body, -points[:, 2], 0.06)  # it sits on a flat base

    tail = ellipsoid(points, (-0.90, 0.0, 0.40), (0.23, 0.23, 0.22))
    eyes = ellipsoid(pair, (0.70, 0.295, 1.56), (0.08, 0.065, 0.095), (0.0, 0.0, 30.0))
    nose = ellipsoid(points, (0.93, 0.0, 1.40), (0.055, 0.075, 0.05))
    return {"body": body, "tail": tail, "eyes": eyes, "nose": nose}
