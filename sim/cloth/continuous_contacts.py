"""Keeps cloths apart from themselves, from bodies and from walls, all through each substep."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sim.cloth.bundles import PushedNodes, Response
from sim.cloth.contact_response import STEPS, push, weigh_contacts
from sim.cloth.contacts import ContactList
from sim.cloth.parameters import MOST_TURNS
from sim.cloth.rigid_contact import RigidContact
from sim.cloth.self_collision import Box, SelfCollision, box_of
from sim.cloth.state import ClothState
from sim.core.bundles import with_room
from sim.core.host_access import copied, take
from sim.core.reductions import LaneReduction, runs_on_gpu

if TYPE_CHECKING:
    from sim.cloth.integrators import ExplicitSprings, XPBDSprings

RELAXED_BEYOND = 0.03  # excess of a spring [rest lengths] beyond which springs and contacts take another turn

MORE_ITERATIONS = 16
"""Steps of the contact iteration, a multiple of `STEPS`, that follow the first `STEPS` where those are not enough, as
in stacks and impacts; two layers under their weight need one step."""

REPAIRS = 4  # rounds in which crossing pairs are pushed before they become impact zones

RECOVERY_TIME_S = 0.01
"""Layers that are too near go apart within about this time: fast enough not to be seen, too slow to bounce."""

LARGEST_MOTION = 0.5
"""How far vertices may get from their common motion in a step, in mean edges: farther, the lists grow too long. Cloths
that are farther apart may come half of the way."""

JAMMED_SHARE = 0.1
"""A cloth is jammed in a frame where impact zones move so much of its nodes as one, on average over the substeps: falls
and folds have some for a few; cloth that wind presses into a heap has most of its nodes there in all."""

IMPULSE_UNIT = 1.0e-5
"""Unit of impulses over the step, in mean masses of a vertex times m/s²: a millionth of the weight, however short the
steps are; 64 bits hold the sum of ten million vertices stopped from 100 m/s in a step of 0.1 ms."""


class ContinuousContacts:
    """Contacts of all cloths of a scene, with themselves, each other, bodies and walls.

    A substep: the pairs of elements that may meet, and what may meet bodies and walls; displacements that keep all of
    them apart by their thickness, with friction; a test that no pair may have crossed on the way. Where it fails, the
    pairs' vertices are pushed, and at last moved as one (`ImpactZones`). So cloth that starts without crossing has
    none at the end of any substep; pins that are led through each other are the exception.

    Attributes:
        rigid: contacts with bodies and walls.

    Args:
        state: the cloths.
        rigid: bodies and walls; None for cloths alone.
    """

    def __init__(self, state: ClothState, *, rigid: RigidContact | None = None) -> None:
        self.rigid = rigid or RigidContact((), (), ())
        self._pairs = SelfCollision(state)
        self.rigid.set_spacing(self._pairs.coarsest_edge, self._pairs.longest_edge)
        n = state.vertex_count
        self._contacts = ContactList(4 * n, drifts=self.rigid.on_device.deforms)
        self._pushed: PushedNodes = with_room(
            PushedNodes,
            n,
            displacement=state.displacement,
            inverse_mass=state.inverse_mass,
            uses=ti.ndarray(ti.i32, 2 * n),
            counter=ti.ndarray(ti.i32, 5),
            held_sums=ti.ndarray(ti.i32, 6 * n),
        )
        self._ends = LaneReduction(maxima=6, sums=0)
        self._state = state
        self._impulse_unit = 0.0
        self._is_warm = self._expects = False
        self._conclude: Callable[[ti.Ndarray], None] | None = None
        self.begin_frame()

    # --- what the solver asks ---------------------------------------------------------------------------------------

    def stable_dt(self, at_most: float) -> float:
        """Largest step [s] in which cloth moves little against itself, and against bodies that it may meet."""
        state = self._state
        n, first = state.vertex_count, state.host.first_node
        asked, self._velocities = self._velocities or box_of(state.velocity, 0, n, self._ends), None
        velocity = asked()
        shortest = self.rigid.stable_dt(
            state, range(n), velocity, at_most=self._little_motion(velocity, at_most) if self._pairs.meets else at_most
        )
        if shortest == at_most or len(state.names) == 1:
            return shortest
        velocities, places = (
            [box_of(vectors, *ends, self._ends)() for ends in pairwise(first.tolist())]
            for vectors in (state.velocity, state.position)
        )
        shortest = at_most
        for number, velocity in enumerate(velocities):
            if state.self_collision[number]:
                shortest = self._little_motion(velocity, shortest)
            shortest = self.rigid.stable_dt(state, range(*first[number : number + 2]), velocity, at_most=shortest)
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

    def _little_motion(self, velocity: Box, at_most: float) -> float:
        """Largest step [s] in which cloth with such a box of velocities [m/s] moves little against itself."""
        return min(at_most, LARGEST_MOTION * self._pairs.mean_edge / max(float(np.linalg.norm(velocity[1])), 1.0e-30))

    def begin_frame(self) -> None:
        """Count anew, and expect of contacts what a run does that continues here."""
        state = self._state
        self._pairs.begin_frame()
        self.rigid.set_thickness(float(copied(state.thickness).min()), self._pairs.thickness)
        self.rigid.colliding.depth.fill(0.0)
        self._substeps = self._found = self._repaired = self._zone_vertices = self._left = 0
        self._velocities: Callable[[], Box] | None = None
        self._moved_as_one, self._nodes_as_one = (np.zeros(len(state.names)) for _ in range(2))
        self._mean_mass = float(copied(state.mass).mean())

    def diagnostics(self) -> Mapping[str, float]:
        """Numbers of the frame: contacts a substep, with watched pairs.

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
            "repaired_crossings": float(self._repaired),
            "impact_zone_vertices": float(self._zone_vertices),
            "crossings_left": float(self._left),
            "jammed": float(is_jammed.any()),
            "bodies_show": float(copied(self.rigid.colliding.depth).max() > 1.0),
        }

    def take_impulses(self, dt: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Linear and angular impulse on every body since the last call [N s], [N m s], (b, 3) each, for steps of dt."""
        impulses = take(self.rigid.pushed.impulse).astype(np.float64).reshape(-1, 6)
        sums = self._impulse_unit * impulses[: self.rigid.count]
        return sums[:, :3] / dt, sums[:, 3:] / dt

    # --- the substep ------------------------------------------------------------------------------------------------

    def resolve(
        self, dt: float, turns: SpringTurns | None = None, conclude: Callable[[ti.Ndarray], None] | None = None
    ) -> bool:
        """Change the displacements of a substep of dt [s], after the springs have, so that nothing crosses; pinned
        nodes stay as they are. Returns whether the step was concluded.

        Args:
            dt: [s].
            turns: that springs take, where contacts stretched them too much; contacts are resolved again then.
            conclude: has the device finish the step if three numbers there are 0, as they are where nothing remains to
                be done: a GPU would wait while the host reads them.
        """
        self._conclude = conclude
        self._pairs.look()
        self.rigid.begin_substep(dt)
        self._impulse_unit = IMPULSE_UNIT * self._mean_mass * dt**2
        self._nodes_as_one.fill(0.0)
        if not self._is_warm:
            self._warm_up()
            self._is_warm = True
        while True:
            found, pushed = self._find(dt, turns)
            if found < 0:
                self._contacts.forget()
                self._velocities = None
                return False  # the solver says which quantity is not finite, or ran away
            if found:
                self._push_in_turns(turns, pushed)
            left, is_beyond, not_finite = self._keep_apart(found)
            if not_finite:
                self._velocities = None
                return False  # as above
            # What was pushed farther than foreseen may have met what was not looked at.
            if not is_beyond:
                break
            self._pairs.look()
        self._substeps += 1
        self._moved_as_one += self._nodes_as_one
        self._found += found
        self._left += left
        self._expects = found > 0
        return conclude is not None

    def _warm_up(self) -> None:
        """Compile what the first contacts need: seconds, which no frame in the middle of a film should take."""
        self._weigh(is_first=True)
        self._push()()
        if self._pairs.meets:
            self._pairs.warm_up()

    def _find(self, dt: float, turns: SpringTurns | None) -> tuple[int, Callable[[], list[int]] | None]:
        """Number of contacts, or -1 where cloth has no bounds; and a first round of pushes, where that has begun.

        It has on a GPU, where there were contacts in the last substep: so the device need not wait for the host.
        """
        recovery, pushed, pairs = min(1.0, dt / RECOVERY_TIME_S), None, self._pairs
        is_ahead = self._expects and runs_on_gpu()
        while True:
            if not is_ahead and not self._has_bounds():
                return -1, None
            pairs.find(self._contacts, recovery, is_ahead=is_ahead)
            asked = self.rigid.find(self._state, pairs.patches, pairs.moving, self._contacts, recovery)
            if is_ahead:
                self._weigh(is_first=True)
                pushed = self._push(turns)
                if not self._has_bounds():
                    return -1, None
                if not pairs.looked()[1]:
                    continue
            found, end = asked()
            had_no_room = pairs.listed.reach_to(end)
            if not self._contacts.make_room_for(found) and not had_no_room:
                return found, pushed

    def _has_bounds(self) -> bool:
        """Whether what was looked at moves within reason."""
        motion, _ = self._pairs.looked()
        return math.isfinite(motion) and motion <= 1.0e6

    def _push_in_turns(self, turns: SpringTurns | None, pushed: Callable[[], list[int]] | None) -> None:
        """Push in turns with the springs, for as long as these need them; the first round may have `pushed` already."""
        if pushed is None:
            self._weigh(is_first=True)
            pushed = self._push(turns)
        while True:
            pushing, is_missing, settled = pushed()
            if turns is None or not (pushing or settled) or not turns.relax():
                break
            pushed = self._push(turns)
        if is_missing:
            self._push_further()

    def _push_further(self) -> None:
        """More steps, where those of a round were not enough."""
        for step in range(0, MORE_ITERATIONS, STEPS):
            self._push(first=step, settles=False, finishes=step + STEPS >= MORE_ITERATIONS)

    def _weigh(self, *, is_first: bool) -> None:
        """Weigh contacts before they push; once for all rounds of what was found."""
        weigh_contacts(self._response, self._state.vertex_count, int(is_first))

    def _push(
        self, turns: SpringTurns | None = None, *, first: int = 0, settles: bool = True, finishes: bool = True
    ) -> Callable[[], list[int]]:
        """`STEPS` steps of the contact iteration, from step `first` on, and how long springs are after them; asks for
        what `push` returns.
        """
        momenta = _momenta_from(first)
        pushed = push.later(
            momenta, int(first == 0), int(settles), int(finishes), self._response, self._state.thickness
        )
        if turns is not None:
            turns.measure()
        return pushed

    @property
    def _response(self) -> Response:
        impulses = self._contacts.impulses(self._impulse_unit)
        return Response(self._contacts.found, impulses, self._pushed, self.rigid.pushed)

    def _keep_apart(self, count: int) -> Sequence[int]:
        """Push, and at last tie together, until no pair can have crossed; what `SelfCollision.finish` returns then."""
        state = self._state
        for _ in range(REPAIRS):
            found = self._finish(count)
            if not found[0]:
                return found
            self._repaired += found[0]
            self._weigh(is_first=False)
            if self._push()()[1]:
                self._push_further()
        found = self._finish(count)
        if found[0]:
            zones, contacts = ImpactZones(state.mass.to_numpy(), state.inverse_mass.to_numpy() == 0.0), self._contacts
            while found[0] and zones.join(
                contacts.found.vertices.to_numpy()[:count][contacts.crossing.to_numpy()[:count] == 1]
            ):
                state.displacement.from_numpy(zones.apply(state.displacement.to_numpy()))
                found = self._finish(count)
            self._zone_vertices += len(zones.members)
            of_cloths = np.bincount(state.host.body[zones.members], minlength=len(self._nodes_as_one))
            np.maximum(self._nodes_as_one, of_cloths, out=self._nodes_as_one)
        return found if not found[0] else (found[0], *self._finish(0, is_changed=True)[1:])

    def _finish(self, count: int, *, is_changed: bool = False) -> Sequence[int]:
        asked = self._pairs.finish(self._pushed.predicted, self._contacts, count, is_changed=is_changed or count > 0)
        if self._conclude is not None:
            self._conclude(self._pairs.outcome)
            self._velocities = box_of(self._state.velocity, 0, self._state.vertex_count, self._ends)
        return asked()


class SpringTurns:
    """Turns that the springs of some cloths take with contacts in a substep of dt [s].

    Attributes:
        taken: how many.
        is_measured: whether it was asked how long springs are.
    """

    def __init__(self, integrator: XPBDSprings | ExplicitSprings, dt: float, cloths: NDArray[np.bool_]) -> None:
        self._integrator, self._dt, self._cloths = integrator, dt, cloths
        self._asked: Callable[[], NDArray[np.float64]] | None = None
        self.taken, self.is_measured = 0, False

    def measure(self) -> None:
        """Ask how long springs are, which the host hears of when it needs to."""
        self._asked, self.is_measured = functools.cache(self._integrator.excess(self._dt)), True

    @property
    def excess(self) -> NDArray[np.float64]:
        """What was measured last [rest lengths], (b,)."""
        assert self._asked is not None
        return self._asked()

    def relax(self) -> bool:
        """Solve springs once more if they were too long when measured; whether they were."""
        if self.taken == MOST_TURNS or self.excess[self._cloths].max(initial=0.0) < RELAXED_BEYOND:
            return False
        self.taken += 1
        self._integrator.sweep(self._dt, self._cloths)
        return True


class ImpactZones:
    """Groups of vertices that get their mean displacement (Provot 1997; without rotation).

    Nothing in a zone can cross, and as a zone grows whenever one of its vertices takes part in another crossing, the
    rounds end. Pinned vertices keep their displacement, and a zone that holds some follows their mean.

    Args:
        mass: of all vertices [kg], (n,).
        pinned: which of them are pinned, (n,) bool.
    """

    def __init__(self, mass: NDArray[np.float32], pinned: NDArray[np.bool_]) -> None:
        self._mass, self._pinned = mass.astype(np.float64), pinned
        self.labels = np.arange(len(mass))

    def join(self, crossing: NDArray[np.int32]) -> bool:
        """Put the four vertices of each crossing pair into one zone; whether any zone grew.

        Args:
            crossing: vertices of the pairs, (m, 4).
        """
        first, *others = self.labels[crossing].T
        count = int(self.labels.max()) + 1
        links = np.tile(first, 3), np.concatenate(others)
        graph = coo_array((np.ones(len(links[0])), links), shape=(count, count))
        found, zone_of_zone = connected_components(graph, directed=False)
        self.labels = zone_of_zone[self.labels]
        return bool(found < count)

    @property
    def members(self) -> NDArray[np.int64]:
        """Vertices that share their zone with others, in ascending order, (k,)."""
        return np.flatnonzero(np.bincount(self.labels)[self.labels] > 1)

    def apply(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        """The displacements [m], (n, 3), with that of each zone for its free vertices."""
        members = self.members
        zone = self.labels[members]
        held = np.bincount(zone, self._pinned[members], minlength=len(self._mass))[zone] > 0.0
        weight = np.where(held, self._pinned[members].astype(np.float64), self._mass[members])
        total = np.bincount(zone, weight, minlength=len(self._mass))
        result = displacement.copy()
        free = ~self._pinned[members]
        for axis in range(3):
            moment = np.bincount(zone, weight * displacement[members, axis], minlength=len(self._mass))
            result[members[free], axis] = (moment[zone] / total[zone])[free].astype(np.float32)
        return result


@functools.cache
def _momenta_from(first: int) -> tuple[float, ...]:
    """Momenta of the steps of one launch, from that of step `first` of an iteration on, and of the step after them."""
    return tuple(k / (k + 3.0) for k in range(first, first + STEPS + 1))
