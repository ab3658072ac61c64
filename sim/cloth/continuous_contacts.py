"""Keeps cloths apart from themselves, from bodies and from walls, all through each substep."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import NodeSums, PatchMotion, PushedNodes
from sim.cloth.continuous_response import STEPS, begin_push, push_on, repair_crossings
from sim.cloth.continuous_zones import ImpactZones
from sim.cloth.lone_cloth import LoneCloth
from sim.cloth.loop_costs import CONTACT_NS, COPIED_NODE_NS
from sim.cloth.proximity_contacts import ContactList
from sim.cloth.rigid_contact import RigidContact
from sim.cloth.self_collision import Box, SelfCollision, box_of
from sim.core.host_access import copied
from sim.core.reductions import LaneReduction
from sim.core.scheduling import is_short

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

MORE_ITERATIONS = 16
"""Steps of the contact iteration, a multiple of `STEPS`, that follow the first `STEPS` where those are not enough, as
in stacks and impacts; two layers under their weight need one step."""

TOLERANCE = 0.02
"""Part of their thickness by which contacts may miss what they should keep."""

REPAIRS = 4
"""Rounds in which crossing pairs are pushed before they become impact zones."""

MANY_CONTACTS = 16
"""Contacts a vertex for which kernels are compiled: heaps and knots come to ten and more."""

LEAST_GAP = 0.02
"""Layers are never let nearer than this, in their thickness, as far as contacts and impact zones decide it."""

RECOVERY_TIME_S = 0.01
"""Layers that are too near go apart within about this time: fast enough not to be seen, too slow to bounce."""

LARGEST_MOTION = 0.5
"""How far vertices may get from their common motion in a step, in mean edges: farther, the lists grow too long. Cloths
that are farther apart may come half of the way."""

JAMMED_SHARE = 0.1
"""A cloth is jammed in a frame where impact zones move so much of its nodes as one, on average over the substeps. Falls
and folds have some for a few substeps; cloth that wind presses into a heap has most of its nodes there in all of them,
and no substep gets by without every round of repairs."""

IMPULSE_UNIT = 1.0e-5
"""Unit of impulses over the step, in mean masses of a vertex times m/s²: a millionth of the weight, however short the
steps are; 64 bits hold the sum of ten million vertices stopped from 100 m/s in a step of 0.1 ms."""


class NearCloth(Protocol):
    """Finds what of the cloths is near other cloth, and tells bodies and walls where to look for it."""

    thickness: float
    """The largest [m]."""

    @property
    def motion(self) -> PatchMotion:
        """Of the patches in the substep."""

    def begin_frame(self, state: ClothState) -> None:
        """Expect of contacts what a run does that continues here."""

    def look(self, state: ClothState) -> float:
        """Note how cloth moves in this substep; returns a bound [m], which is not finite or huge after a blow-up."""

    def prepare(self, state: ClothState) -> None:
        """After `look`: have all pairs listed that may meet in this substep."""

    def find(self, state: ClothState, contacts: ContactList, recovery: float) -> None:
        """Append the pairs that are too near; `recovery` is the share of a missing distance that comes back [-]."""

    def measure_changes(self, state: ClothState, predicted: ti.Ndarray) -> tuple[float, float]:
        """How far contacts displaced vertices at most [m]; and those that they displaced farther than allowed for."""

    def follow(self, state: ClothState, *, is_changed: bool) -> None:
        """A substep is over, in which `measure_changes` was asked, or not."""


class ContinuousContacts:
    """Contacts of all cloths of a scene; implements `sim.cloth.contacts.ClothContacts`.

    A substep: the pairs of elements that may meet, and what may meet bodies and walls; displacements that keep all of
    them apart by their thickness, with friction; a test that no pair may have crossed on the way. Where it fails, the
    pairs' vertices are pushed, and at last moved as one (`ImpactZones`). So cloth that starts without crossing has
    none at the end of any substep, whatever its speed; pins that are led through each other are the exception.

    Linear momentum is kept to rounding. Angular momentum is kept by what pushes along the line between the points that
    touch; friction between layers acts on two points a thickness apart, and spins by that arm.

    Attributes:
        rigid: contacts with bodies and walls.

    Args:
        state: the cloths.
        rigid: bodies and walls; None for cloths alone.
    """

    def __init__(self, state: ClothState, *, rigid: RigidContact | None = None) -> None:
        self.rigid = rigid or RigidContact((), (), ())
        self._pairs = SelfCollision(state)
        self._patches = self._pairs.patches
        self._lone = LoneCloth(state, self._patches)
        self.rigid.set_spacing(self._pairs.coarsest_edge, self._pairs.longest_edge)
        n = state.vertex_count
        self._contacts = ContactList(4 * n)
        self._pushed = PushedNodes(
            displacement=state.displacement,
            inverse_mass=state.inverse_mass,
            start=ti.Vector.ndarray(3, ti.f32, n),
            reached=ti.Vector.ndarray(3, ti.f32, n),
            touched=ti.ndarray(ti.i32, n),
            uses=ti.ndarray(ti.i32, 2 * n),
            support=ti.Vector.ndarray(3, ti.f32, n),
        )
        self._pushed.support.fill(0.0)
        self._sums = NodeSums(
            counter=ti.ndarray(ti.i32, 3),
            predicted=ti.Vector.ndarray(3, ti.f32, n),
            shares=ti.ndarray(ti.i32, n),
            held_sums=ti.ndarray(ti.i32, 6 * n),
            lever=ti.ndarray(ti.f32, n),
            pressing_body=ti.ndarray(ti.i32, n),
        )
        self._crossing, self._crossing_count = ti.ndarray(ti.i32, 4 * n), ti.ndarray(ti.i32, 1)
        self._missing, self._ends = LaneReduction(maxima=1, sums=0), LaneReduction(maxima=6, sums=0)
        self._state = state
        self._impulse_unit = 0.0
        self._meets_cloth, self._is_warm = False, False
        self._near: NearCloth = self._lone
        self.begin_frame()

    # --- what the solver asks ---------------------------------------------------------------------------------------

    def stable_dt(self, state: ClothState, at_most: float) -> float:
        """Largest step [s] in which cloth moves little against itself, and against bodies that it may meet."""
        n, first = state.vertex_count, state.host.first_node
        velocity = self._box(state.velocity, 0, n)
        shortest = self.rigid.stable_dt(
            *velocity,
            lambda: self._box(state.position, 0, n),
            at_most=self._little_motion(velocity, at_most) if self._meets_cloth else at_most,
        )
        if shortest == at_most or len(state.names) == 1:
            return shortest
        velocities, places = (
            [self._box(vectors, *ends) for ends in pairwise(first)] for vectors in (state.velocity, state.position)
        )
        shortest = at_most
        for number, (velocity, place) in enumerate(zip(velocities, places, strict=True)):
            if state.self_collision[number]:
                shortest = self._little_motion(velocity, shortest)
            shortest = self.rigid.stable_dt(*velocity, lambda place=place: place, at_most=shortest)
        for a, b in combinations(range(len(state.names)), 2):
            apart, closing = (
                np.abs(each[a][0] - each[b][0]) + sign * (each[a][1] + each[b][1])
                for each, sign in ((places, -1.0), (velocities, 1.0))
            )
            room = float(np.linalg.norm(np.maximum(apart, 0.0))) - self._pairs.thickness
            from_far = 0.5 * room / max(float(np.linalg.norm(closing)), 1.0e-30)
            together = self._little_motion((velocities[a][0], 0.5 * closing), shortest)
            shortest = min(shortest, max(together, from_far))
        return shortest

    def _box(self, vectors: ti.Ndarray, first: int, end: int) -> Box:
        return box_of(vectors, int(first), int(end), self._ends)

    def _little_motion(self, velocity: Box, at_most: float) -> float:
        """Largest step [s] in which cloth with such a box of velocities [m/s] moves little against itself."""
        return min(at_most, LARGEST_MOTION * self._pairs.mean_edge / max(float(np.linalg.norm(velocity[1])), 1.0e-30))

    def begin_frame(self) -> None:
        """Count anew, and expect of contacts what a run does that continues here."""
        state = self._state
        self._meets_cloth = len(state.names) > 1 or any(state.self_collision)
        # Pairs that have not followed the cloth for a while find, as they look, how far it is from where they left it.
        self._near = self._pairs if self._meets_cloth else self._lone
        self._near.begin_frame(state)
        self.rigid.set_thickness(float(copied(state.thickness).min()), self._near.thickness)
        self.rigid.bodies.begin_frame()
        self._substeps = self._found = self._iterations = self._repaired = self._zone_vertices = self._left = 0
        self._moved_as_one, self._nodes_as_one = (np.zeros(len(state.names)) for _ in range(2))
        self._mean_mass = float(copied(state.mass).mean())

    def diagnostics(self) -> Mapping[str, float]:
        """Numbers of the frame: contacts, with watched pairs, and iterations a substep.

        `repaired_crossings` counts pairs that contacts alone would have let cross, `impact_zone_vertices` the vertices
        that had to move with others, `crossings_left` pairs that even so may have crossed, as where pins are led
        through each other; all summed over the substeps. `jammed` is 1 in a frame with a cloth of which impact zones
        moved more than `JAMMED_SHARE`, on average over the substeps; `bodies_show` in one where cloth was deeper in a
        body than it is thick.
        """
        body = self._state.host.body
        nodes = np.bincount(body, minlength=len(self._moved_as_one))
        is_jammed = self._moved_as_one > JAMMED_SHARE * max(self._substeps, 1) * nodes
        return {
            "contacts": self._found / max(self._substeps, 1),
            "contact_iterations": self._iterations / max(self._substeps, 1),
            "repaired_crossings": float(self._repaired),
            "impact_zone_vertices": float(self._zone_vertices),
            "crossings_left": float(self._left),
            "jammed": float(is_jammed.any()),
            "bodies_show": float(copied(self.rigid.bodies.depth).max() > 1.0),
        }

    def take_impulses(self, dt: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Linear and angular impulse on every body since the last call [N s], [N m s], (b, 3) each, for steps of dt."""
        linear, angular = self.rigid.bodies.take_impulses(self._impulse_unit)
        return linear / dt, angular / dt

    # --- the substep ------------------------------------------------------------------------------------------------

    def resolve(self, state: ClothState, dt: float, relax: Callable[[], bool]) -> None:
        """Change the displacements of a substep of dt [s] so that nothing crosses; see `ClothContacts`."""
        motion = self._near.look(state)
        if not math.isfinite(motion) or motion > 1.0e6:
            return  # the solver says which quantity is not finite, or ran away
        self.rigid.begin_substep(dt)
        self._impulse_unit = IMPULSE_UNIT * self._mean_mass * dt**2
        self._nodes_as_one.fill(0.0)
        if not self._is_warm:
            self._warm_up(state)
            self._is_warm = True
        while True:
            self._near.prepare(state)
            found = self._find(state, dt)
            if not found:
                left = 0
                break
            self._push(state, found, is_first=True, relax=relax)
            left = self._keep_apart(state, found)
            change, beyond = self._near.measure_changes(state, self._sums.predicted)
            if not math.isfinite(change):
                return  # as above
            # What was pushed farther than foreseen may have met what was not looked at.
            if not beyond:
                break
            self._near.look(state)
        self._near.follow(state, is_changed=found > 0)
        self._substeps += 1
        self._moved_as_one += self._nodes_as_one
        self._found += found
        self._left += left

    def _warm_up(self, state: ClothState) -> None:
        """Compile what the first contacts need: seconds, which no frame in the middle of a film should take."""
        for short in sorted({self._is_short(0), self._is_short(MANY_CONTACTS * state.vertex_count)}):
            self._begin_push(state, 0, is_first=True, short=short)
            self._push_on(0, 0, 0, short=short)
            if self._meets_cloth:
                self._crossings(state, 0, short=short)
        self._near.measure_changes(state, self._sums.predicted)
        if self._meets_cloth:
            self._pairs.warm_up()

    def _find(self, state: ClothState, dt: float) -> int:
        recovery = min(1.0, dt / RECOVERY_TIME_S)
        while True:
            self._near.find(state, self._contacts, recovery)
            self.rigid.find(state, self._patches, self._near.motion, self._contacts, recovery)
            found = self._contacts.take_found()
            if not self._contacts.make_room_for(found):
                return found

    def _push(
        self, state: ClothState, count: int, *, is_first: bool, relax: Callable[[], bool] = lambda: False
    ) -> None:
        """Push; first in turns with the springs, for as long as these `relax`."""
        short = self._is_short(count)
        while True:
            pushing, touched, missing = self._begin_push(state, count, is_first=is_first, short=short)
            self._iterations += STEPS if pushing else 0
            if not pushing or not relax():
                break
            is_first = False
        if pushing and not np.int32(missing).view(np.float32) <= TOLERANCE:
            for first in range(0, MORE_ITERATIONS, STEPS):
                self._push_on(pushing, touched, first, short=short)
            self._iterations += MORE_ITERATIONS

    def _begin_push(self, state: ClothState, count: int, *, is_first: bool, short: bool) -> list[int]:
        """A round of the first `STEPS` steps; what `begin_push` returns."""
        contacts = self._contacts
        found: list[int] = begin_push(
            _momenta_from(0),
            count,
            contacts.found,
            contacts.impulses(self._impulse_unit),
            state.vertex_count,
            self._pushed,
            self._sums,
            state.thickness,
            self.rigid.bodies.pushed,
            self._missing.tree,
            int(is_first),
            short,
        )
        return found

    def _push_on(self, count: int, touched: int, first: int, *, short: bool) -> None:
        """More steps of the contact iteration, from step `first` of `MORE_ITERATIONS` on."""
        contacts = self._contacts
        push_on(
            _momenta_from(first),
            int(first == 0),
            int(first + STEPS >= MORE_ITERATIONS),
            count,
            touched,
            contacts.found,
            contacts.impulses(self._impulse_unit),
            self._pushed,
            self.rigid.bodies.pushed,
            short,
        )

    def _keep_apart(self, state: ClothState, count: int) -> int:
        """Push, and at last tie together, until no pair can have crossed; how many pairs still may have."""
        if not self._meets_cloth:
            return 0
        short = self._is_short(count)
        for _ in range(REPAIRS):
            failed = self._crossings(state, count, short=short)
            if not failed:
                return 0
            self._repaired += failed
            self._push(state, count, is_first=False)
        failed = self._crossings(state, count, short=short)
        if failed:
            zones = ImpactZones(state.mass.to_numpy(), state.inverse_mass.to_numpy() == 0.0)
            while failed and zones.join(self._contacts.vertices.to_numpy()[:count][self._crossing_rows(count)]):
                state.displacement.from_numpy(zones.apply(state.displacement.to_numpy()))
                failed = self._crossings(state, count, short=short)
            self._zone_vertices += len(zones.members)
            of_cloths = np.bincount(state.host.body[zones.members], minlength=len(self._nodes_as_one))
            np.maximum(self._nodes_as_one, of_cloths, out=self._nodes_as_one)
        return failed

    def _crossings(self, state: ClothState, count: int, *, short: bool) -> int:
        contacts = self._contacts
        if self._crossing.shape[0] < contacts.capacity:
            self._crossing = ti.ndarray(ti.i32, contacts.capacity)
        return int(
            repair_crossings(
                count,
                contacts.found,
                contacts.impulse,
                state.position,
                state.displacement,
                state.inverse_mass,
                state.thickness,
                LEAST_GAP,
                self._crossing,
                self._crossing_count,
                short,
            )
        )

    def _is_short(self, count: int) -> bool:
        """Whether loops over so many contacts, and over all vertices, are."""
        return is_short(count, CONTACT_NS) and is_short(self._state.vertex_count, COPIED_NODE_NS)

    def _crossing_rows(self, count: int) -> NDArray[np.bool_]:
        return self._crossing.to_numpy()[:count] == 1


def _momenta_from(first: int) -> tuple[float, ...]:
    """Momenta of the steps of one launch, from that of step `first` of an iteration on, and of the step after them."""
    return tuple(k / (k + 3.0) for k in range(first, first + STEPS + 1))
