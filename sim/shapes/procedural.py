"""The procedural shapes: a rubber duck that swims along +x, and a bunny that sits on its base and looks along +x."""

from __future__ import annotations

from sim.shapes.modelling import (
    Distances,
    ellipsoid,
    mirrored,
    procedural_solid,
    round_cone,
    smooth_difference,
    smooth_intersection,
    smooth_union,
)
from sim.shapes.solid import Points


def _duck_parts(points: Points) -> dict[str, Distances]:
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


build_duck = procedural_solid(_duck_parts, (-1.6, -1.1, -0.8), (1.6, 1.1, 1.8), axis=0)
"""The duck by its length [m] from bill to tail."""


def _bunny_parts(points: Points) -> dict[str, Distances]:
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


build_bunny = procedural_solid(_bunny_parts, (-1.3, -1.0, -0.1), (1.3, 1.0, 3.0), axis=2)
"""The bunny by its height [m] from base to ears."""
