"""The contacts of a substep: what comes near what, and the least that their displacements must differ by."""

import numpy as np
import taichi as ti

from sim.cloth.bundles import Contacts, Impulses

VERTEX_TRIANGLE, EDGE_EDGE, WALL = -1, -2, -3
"""What a contact is between; from 0 on it is the number of the body that the cloth touches."""

INACTIVE = -1.0e30
"""Floor of a pair that is watched but pushes nothing."""

GROWTH = 1.5


class ContactList:
    """Contacts in no particular order, which no result depends on: all sums over them are sums of integers.

    The points of a contact are weighted means of vertices, and so is the relative displacement
    w = sum_k weights[k] u[vertices[k]], minus that of the body. It has to satisfy n . w >= floor.

    Attributes:
        vertices: up to four, (capacity,) of 4-vectors; of a vertex and a triangle in this order, of two edges in turn.
        weights: signed, zero for vertices that do not count, (capacity,) of 4-vectors.
        normal: unit vector from the second to the first, or out of the body, (capacity,) of 3-vectors.
        floor: least relative displacement along the normal [m], or `INACTIVE`, (capacity,).
        kind: `VERTEX_TRIANGLE`, `EDGE_EDGE`, `WALL`, or the number of a body, (capacity,).
        arm: from the body's centre of mass to the point [m], (capacity,) of 3-vectors.
        friction: Coulomb's coefficient [-], (capacity,).
        mobility: what the relative displacement grows by per impulse, all contacts pushing alike [1/kg], (capacity,).
        impulse: on the first, minus that on the second, times the step [kg m], (capacity,) of 3-vectors.
        impulse_before, impulse_given: that of an iteration earlier, and that which displacements contain already.
        pushing: numbers of the contacts that push, (capacity,); `push` is what they give in a step of the iteration, in
            its units, in the same order.
        crossing: whether pairs may have crossed, (capacity,).
        used_by, use_weight: places of contacts in that order, and weights, vertex by vertex, (4 capacity,).
        found: what finding contacts writes, for kernels.
        counter: number of contacts found, also those beyond the capacity; ends that lists of pairs need; number of
            contacts that may push, 0 if what was found is not all; whether it is all of cloth with cloth, (5,).
    """

    def __init__(self, capacity: int) -> None:
        self.counter = ti.ndarray(ti.i32, 5)
        self.forget()
        self._allocate(capacity)

    def forget(self) -> None:
        """Nothing is found."""
        self.counter.from_numpy(np.array([0, 0, 0, 0, 1], dtype=np.int32))

    def make_room_for(self, found: int) -> bool:
        """Whether so many contacts did not fit, so that they have to be found again; now there is room."""
        if found <= self.capacity:
            return False
        self._allocate(int(GROWTH * found))
        return True

    def impulses(self, unit: float) -> Impulses:
        """The impulses for kernels, which are summed up in a unit [kg m]."""
        return Impulses(
            self.mobility,
            self.impulse,
            self.impulse_before,
            self.impulse_given,
            self.pushing,
            self.push,
            self.used_by,
            self.use_weight,
            unit,
        )

    def _allocate(self, capacity: int) -> None:
        self.capacity = max(capacity, 1)
        self.vertices = ti.Vector.ndarray(4, ti.i32, self.capacity)
        self.weights = ti.Vector.ndarray(4, ti.f32, self.capacity)
        self.normal = ti.Vector.ndarray(3, ti.f32, self.capacity)
        self.floor = ti.ndarray(ti.f32, self.capacity)
        self.kind = ti.ndarray(ti.i32, self.capacity)
        self.arm = ti.Vector.ndarray(3, ti.f32, self.capacity)
        self.friction = ti.ndarray(ti.f32, self.capacity)
        self.mobility = ti.ndarray(ti.f32, self.capacity)
        self.impulse, self.impulse_before, self.impulse_given = (
            ti.Vector.ndarray(3, ti.f32, self.capacity) for _ in range(3)
        )
        self.pushing, self.crossing = (ti.ndarray(ti.i32, self.capacity) for _ in range(2))
        self.push = ti.Vector.ndarray(3, ti.f32, self.capacity)
        self.used_by, self.use_weight = ti.ndarray(ti.i32, 4 * self.capacity), ti.ndarray(ti.f32, 4 * self.capacity)
        self.found = Contacts(
            vertices=self.vertices,
            weights=self.weights,
            normal=self.normal,
            floor=self.floor,
            kind=self.kind,
            arm=self.arm,
            friction=self.friction,
            counter=self.counter,
            capacity=self.capacity,
        )


@ti.func
def least_displacement(distance: ti.f32, wanted: ti.f32, recovery: ti.f32) -> ti.f32:
    """Floor of a contact: farther apart than wanted may come nearer, nearer goes apart by a share of what is missing.

    Args:
        distance: at the start of the step [m].
        wanted: distance to keep [m].
        recovery: share of a missing distance that a step gives back [-].
    """
    return ti.select(distance >= wanted, wanted - distance, recovery * (wanted - distance))
