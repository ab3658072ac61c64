"""Closest points of a point and a triangle, and of two edges: where cloth is nearest to cloth.

Coordinates are relative to a point nearby, so that float32 resolves distances far below the length of an edge.
"""

import taichi as ti

Vector3 = ti.math.vec3

NEARLY_PARALLEL = 1.0e-6
"""Squared sine of an angle below which two edges count as parallel: float32 knows no more about it."""


@ti.func
def closest_on_triangle(p: Vector3, a: Vector3, b: Vector3, c: Vector3) -> Vector3:
    """Barycentric coordinates of the point of the triangle a, b, c nearest to p (Ericson 2005, section 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab.dot(ap), ac.dot(ap)
    d3, d4 = ab.dot(p - b), ac.dot(p - b)
    d5, d6 = ab.dot(p - c), ac.dot(p - c)
    weights = Vector3(0.0)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        weights = Vector3(1.0, 0.0, 0.0)
    elif d3 >= 0.0 and d4 <= d3:
        weights = Vector3(0.0, 1.0, 0.0)
    elif d6 >= 0.0 and d5 <= d6:
        weights = Vector3(0.0, 0.0, 1.0)
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        along = d1 / ti.max(d1 - d3, 1.0e-30)
        weights = Vector3(1.0 - along, along, 0.0)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        along = d2 / ti.max(d2 - d6, 1.0e-30)
        weights = Vector3(1.0 - along, 0.0, along)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        along = (d4 - d3) / ti.max((d4 - d3) + (d5 - d6), 1.0e-30)
        weights = Vector3(0.0, 1.0 - along, along)
    else:
        total = ti.max(va + vb + vc, 1.0e-30)
        v, w = vb / total, vc / total
        weights = Vector3(1.0 - v - w, v, w)
    return weights


@ti.func
def closest_on_edges(p: Vector3, q: Vector3, a: Vector3, b: Vector3) -> ti.math.vec2:
    """Shares s, t in [0, 1] of the nearest points p + s (q - p) and a + t (b - a) (Ericson 2005, section 5.1.9)."""
    d1, d2, r = q - p, b - a, p - a
    a11, a22 = ti.max(d1.dot(d1), 1.0e-30), ti.max(d2.dot(d2), 1.0e-30)
    a12, c1, c2 = d1.dot(d2), d1.dot(r), d2.dot(r)
    determinant = a11 * a22 - a12 * a12
    s = 0.5
    if determinant > NEARLY_PARALLEL * a11 * a22:
        s = ti.math.clamp((a12 * c2 - c1 * a22) / determinant, 0.0, 1.0)
    t = ti.math.clamp((a12 * s + c2) / a22, 0.0, 1.0)
    s = ti.math.clamp((a12 * t - c1) / a11, 0.0, 1.0)
    return ti.math.vec2(s, ti.math.clamp((a12 * s + c2) / a22, 0.0, 1.0))


@ti.func
def distance_to_triangle(p: Vector3, a: Vector3, b: Vector3, c: Vector3) -> ti.f32:
    """Distance of a point to a triangle [m]."""
    weights = closest_on_triangle(p, a, b, c)
    return (p - weights[0] * a - weights[1] * b - weights[2] * c).norm()


@ti.func
def distance_of_edges(p: Vector3, q: Vector3, a: Vector3, b: Vector3) -> ti.f32:
    """Distance of two edges p q and a b [m]."""
    shares = closest_on_edges(p, q, a, b)
    return (p + shares[0] * (q - p) - a - shares[1] * (b - a)).norm()


@ti.func
def unit_or(vector: Vector3, fallback: Vector3) -> Vector3:
    """The direction of a vector; that of another where it has none, and z where neither has."""
    direction = Vector3(0.0, 0.0, 1.0)
    length, other = vector.norm(), fallback.norm()
    if length > 1.0e-12:
        direction = vector / length
    elif other > 1.0e-20:
        direction = fallback / other
    return direction
