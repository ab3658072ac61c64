"""The contacts of a substep: what comes near what, and the least that their displacements must differ by."""

import numpy as np
import taichi as ti

from sim.cloth.bundles import Contacts, Four, Impulses
from sim.core.bundles import func, with_room

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
