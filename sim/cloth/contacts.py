"""Contacts of a substep: where elements are nearest to each other, what comes near what, and the least that their
displacements must differ by. Coordinates are relative to a point nearby, so that float32 resolves distances far below
the length of an edge.
"""

import numpy as np
import taichi as ti

from sim.cloth.bundles import Contacts, Four, Impulses
from sim.core.bundles import func, with_room

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


VERTEX_TRIANGLE, EDGE_EDGE, WALL = -1, -2, -3
"""What a contact is between; from 0 on it is the number of the body that the cloth touches."""

INACTIVE = -1.0e30  # floor of a pair that is watched but pushes nothing

GROWTH = 1.5


class ContactList:
    """Contacts in no particular order, which no result depends on: all sums over them are sums of integers.

    The points of a contact are weighted means of vertices, and so is the relative displacement
    w = sum_k weights[k] u[vertices[k]], minus that of the body, as it moves and deforms. It has to satisfy
    n . w >= floor.

    Attributes:
        capacity: there is room for so many.
        found: what finding contacts writes; its `counter` has how many were found, also those beyond the capacity; the
            end that the list of pairs needs; how many may push, 0 if what was found is not all; and whether it is all
            of cloth with cloth.
        crossing: whether pairs may have crossed, (capacity,).
    """

    def __init__(self, capacity: int, *, drifts: bool = False) -> None:
        """Room for so many; `drifts` where some are with bodies that deform."""
        self._drifts = drifts
        self._counter = ti.ndarray(ti.i32, 4)
        self.forget()
        self._allocate(capacity)

    def forget(self) -> None:
        """Nothing is found."""
        self._counter.from_numpy(np.array([0, 0, 0, 1], dtype=np.int32))

    def make_room_for(self, found: int) -> bool:
        """Whether so many contacts did not fit, so that they have to be found again; now there is room."""
        if found <= self.capacity:
            return False
        self._allocate(int(GROWTH * found))
        return True

    def impulses(self, unit: float = 1.0) -> Impulses:
        """The impulses for kernels, which are summed up in a unit [kg m]."""
        return self._impulses._replace(unit=unit)

    def _allocate(self, capacity: int) -> None:
        self.capacity = max(capacity, 1)
        # Kernels bear no further array: drifts follow the arms.
        arm = ti.Vector.ndarray(3, ti.f32, (2 if self._drifts else 1) * self.capacity)
        self.found: Contacts = with_room(
            Contacts, self.capacity, counter=self._counter, capacity=self.capacity, arm=arm, drifts=self._drifts
        )
        uses = {"used_by": ti.ndarray(ti.i32, 4 * self.capacity), "use_weight": ti.ndarray(ti.f32, 4 * self.capacity)}
        self._impulses: Impulses = with_room(Impulses, self.capacity, unit=1.0, **uses)
        self.crossing = ti.ndarray(ti.i32, self.capacity)


@func
def append_contact(
    contacts: Contacts,
    vertices: Four,
    weights: ti.math.vec4,
    normal: ti.math.vec3,
    floor: ti.f32,
    kind: ti.i32,
    arm: ti.math.vec3,
    friction: ti.f32,
) -> ti.i32:
    """Append a contact if there is room; it is counted in any case. Returns its number."""
    slot = ti.atomic_add(contacts.counter[0], 1)
    if slot < contacts.capacity:
        contacts.vertices[slot], contacts.weights[slot], contacts.normal[slot] = vertices, weights, normal
        contacts.floor[slot], contacts.kind[slot] = floor, kind
        contacts.arm[slot], contacts.friction[slot] = arm, friction
    return slot


@ti.func
def least_displacement(distance: ti.f32, wanted: ti.f32, recovery: ti.f32) -> ti.f32:
    """Floor of a contact: farther apart than wanted may come nearer, nearer goes apart by a share of what is missing.

    Args:
        distance: at the start of the step [m].
        wanted: distance to keep [m].
        recovery: share of a missing distance that a step gives back [-].
    """
    return ti.select(distance >= wanted, wanted - distance, recovery * (wanted - distance))
