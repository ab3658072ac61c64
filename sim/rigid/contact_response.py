"""What contacts do to bodies in a step: impacts, resting, friction, and moving overlapping bodies apart."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.reductions import runs_on_gpu
from sim.rigid.collision import CollisionDetector
from sim.rigid.contact_solver import (
    COARSE_CONTACTS,
    COARSE_SPEED,
    COARSE_WORK,
    FEWEST_ITERATIONS,
    MAX_ITERATIONS,
    NO_IMPULSES,
    NO_LINKS,
    NOT_CARRIED,
    RELATIVE_TOLERANCE,
    Apart,
    Carried,
    ContactSystem,
    Solution,
    solve_velocities,
)
from sim.rigid.contacts import Array, Contacts, Indices
from sim.rigid.joint_points import no_points
from sim.rigid.joint_system import JointDemand, solve_alone
from sim.rigid.joints import Joints, JointStep
from sim.rigid.parts import PartsDetector
from sim.rigid.pile import Pile
from sim.rigid.restitution import Bounces, slowest_bounce, solve_impacts
from sim.rigid.states import MovingBodies

SEPARATION_TIME_S, LARGEST_SEPARATION = 0.01, 0.2  # in which overlaps decay, and by what share a step at most
SLOP = 1.0e-6  # overlap that stays [m]: below what anybody sees, above what rounding makes
MOST_ROUNDS = 50  # of impacts in a step; after them what still approaches no longer bounces
WEIGHT_TOLERANCE = 1.0e-4  # of the speed that gravity gives in a step: what the last sweep may still change


@dataclass(frozen=True, eq=False)
class Surfaces:
    """How surfaces rub and rebound, by number of the body; a wall is like whatever touches it."""

    friction: Array  # [-], (n,)
    restitution: Array  # [-], (n,)

    def of_pairs(self, first: Indices, second: Indices) -> tuple[Array, Array]:
        """Friction, the geometric mean, and restitution, the larger of two, of pairs of bodies, (k,) each."""
        partner = np.where(second == len(self.friction), first, second)  # the domain follows the bodies
        return (
            np.sqrt(self.friction[first] * self.friction[partner]),
            np.maximum(self.restitution[first], self.restitution[partner]),
        )


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the contacts of a step did besides changing velocities."""

    extra: Array  # (v, omega) added in this step's change of poses only [m/s], [rad/s], (n + 1, 6)
    is_touched: NDArray[np.bool_]  # bodies that got an impulse, (n,) bool
    is_held: NDArray[np.bool_]  # bodies that got one from what cannot move, (n,) bool
    forces: Array | None  # at the contacts, from which the next step starts [N], (k, 3), where they are not kept yet
    iterations: int  # sweeps of the solver
    converged: bool  # whether it converged
    joint_impulses: Array  # of the joints, (r,), if there are any
    impulses: Array  # of the contacts on their first bodies, impacts included [N s], (k, 3); a `Pile` tells none


class ContactResponse:
    """Resolves the contacts of a step, starting from the forces of the step before; gravity is in m/s².

    Contacts that neither bounce nor are of parts nor have joints, or what deforms, beside them are solved by a `Pile`.

    Attributes:
        in_colours: whether it solves them many side by side: on GPUs, where islands would be solved by a thread each.
    """

    def __init__(self, surfaces: Surfaces, gravity: Array) -> None:
        self._surfaces, self._gravity = surfaces, gravity
        self.in_colours: bool | None = None
        self._pile: Pile | None = None

    def resolve(
        self,
        detector: CollisionDetector | PartsDetector,
        bodies: MovingBodies,
        dt: float,
        ease: Array,
        joints: Joints | None = None,
        step: JointStep | None = None,
        carried: Callable[[Contacts], Carried] | None = None,
    ) -> Outcome:
        """Change the velocities of active bodies, (n,), so that contacts hold, bounce and rub over a step of dt [s].

        A detector has found their contacts. How easily impulses move bodies, and that others do not, is
        `ContactSystem.ease`; joints, with their step, hold where contacts are; where surfaces deform, they carry some
        contacts.

        A contact with a gap may close within the step: w_n >= -gap / dt (speculative, so that nothing tunnels).
        """
        n = len(bodies)
        if not detector.active_count():
            nobody = np.zeros(n, dtype=bool)
            still = np.zeros(0 if step is None else len(step.values))
            return Outcome(np.zeros((n + 1, 6)), nobody, nobody.copy(), None, 0, True, still, np.zeros((0, 3)))
        if self.in_colours is None:
            self.in_colours = runs_on_gpu()
        if step is not None or carried is not None or not isinstance(detector, CollisionDetector):
            return self._resolve_some(detector.contacts(), bodies, dt, ease, joints, step, carried)
        rows = self._struck(detector, bodies, dt, ease)
        if not len(rows):
            return self._resolve_pile(detector, bodies, dt, ease)
        contacts, of_others = detector.contacts(), ease.copy()
        struck = contacts.chosen(rows)
        if len(rows) == len(contacts):
            return self._resolve_some(contacts, bodies, dt, ease)
        for numbers in (struck.first, struck.second):
            of_others[np.minimum(numbers, n)] = 0.0
        outcome = self._resolve_some(struck, bodies, dt, ease)
        others = self._resolve_pile(detector, bodies, dt, of_others)
        forces = detector.contacts().force.copy()
        forces[rows] = outcome.forces
        return Outcome(
            outcome.extra + others.extra,
            outcome.is_touched | others.is_touched,
            outcome.is_held | others.is_held,
            forces,
            max(outcome.iterations, others.iterations),
            outcome.converged and others.converged,
            NO_IMPULSES,
            np.zeros((0, 3)),
        )

    def _struck(self, detector: CollisionDetector, bodies: MovingBodies, dt: float, ease: Array) -> Indices:
        """Rows of the contacts of islands in which something bounces now."""
        none = np.zeros(0, dtype=np.int64)
        if not self._surfaces.restitution.any() or not self._may_bounce(detector, bodies, dt):
            return none
        contacts = detector.contacts()
        restitution = self._surfaces.of_pairs(contacts.first, contacts.second)[1]
        rows = np.flatnonzero(restitution)
        if not len(rows):
            return none
        may, position = contacts.chosen(rows), np.concatenate([bodies.position, np.zeros((1, 3))])
        pairs = np.minimum(np.stack([may.first, may.second], axis=1), len(bodies)).astype(np.int32)
        system = ContactSystem(may.point, may.normal, pairs, position, ease, none, none, NO_LINKS)
        velocity = np.concatenate([np.hstack([bodies.velocity, bodies.angular_velocity]), np.zeros((1, 6))])
        found = Bounces.find(
            may,
            bodies,
            approach=system.along_normals(velocity),
            restitution=restitution[rows],
            gravity=self._gravity,
            dt=dt,
        )
        if not found.happens.any():
            return none
        islands = ContactSystem.build(contacts, bodies.position, ease).islands
        return np.flatnonzero(np.isin(islands, islands[rows[found.happens]]))

    def _may_bounce(self, detector: CollisionDetector, bodies: MovingBodies, dt: float) -> bool:
        """Whether any contact may bounce: a look from above at what `Bounces` find exactly."""
        from sim.rigid.step_kernels import count_bouncing

        _, _, on_device, placed = detector.on_device()
        velocity, angular_velocity = map(np.ascontiguousarray, (bodies.velocity, bodies.angular_velocity))
        bouncing, restitution = np.zeros(1, dtype=np.int32), np.append(self._surfaces.restitution, 0.0)
        fall, slowest = dt * self._gravity[None], slowest_bounce(self._gravity, dt)
        count_bouncing(
            detector.contact_count, placed, on_device, velocity, angular_velocity, restitution, fall, slowest, dt,
            bouncing,
        )  # fmt: skip
        return bool(bouncing[0])

    def _resolve_some(
        self,
        contacts: Contacts,
        bodies: MovingBodies,
        dt: float,
        ease: Array,
        joints: Joints | None = None,
        step: JointStep | None = None,
        carried: Callable[[Contacts], Carried] | None = None,
    ) -> Outcome:
        """As `resolve`, of these contacts, whole islands, by the host."""
        n = len(bodies)
        links = NO_LINKS if step is None else step.system.links()
        led = NOT_CARRIED if carried is None else carried(contacts)
        points = no_points(0) if joints is None else joints.points
        ends = n + 1 + len(points)  # of bodies that no surface carries
        ease = np.concatenate([ease, np.zeros((len(points), 7))])
        ease[n + 1 :, 0] = points.inverse_mass
        system = ContactSystem.build(contacts, bodies.position, ease, links, led)
        friction, restitution = self._surfaces.of_pairs(contacts.first, contacts.second)
        least_normal = -np.maximum(contacts.gap, 0.0) / dt
        before = np.zeros((len(system.ease), 6))
        before[:n, :3], before[:n, 3:] = bodies.velocity, bodies.angular_velocity
        before[n + 1 : ends, :3], before[ends:, :3] = points.velocity, led.velocity
        of_impacts, of_step, by_joints = None, None, NO_IMPULSES
        if joints is not None and step is not None:
            of_impacts, of_step = joints.impacts(step), joints.velocities(step)
            alone = solve_alone(of_impacts, before)  # impacts are of bodies that the joints hold already
            before, by_joints = alone.velocity, alone.impulses
        impacts, bounces = self._bounce(
            contacts, bodies, system, before, friction, restitution, least_normal, dt, of_impacts
        )
        solution = solve_velocities(
            system,
            impacts.velocity,
            least_normal=least_normal,
            friction=friction,
            start=dt * contacts.force,
            relative_tolerance=RELATIVE_TOLERANCE,
            tolerance=self._tolerance(dt),
            joints=of_step,
            most=system.most_sweeps(before),
            apart=_separation(contacts, bounces, dt),
        )
        bodies.velocity, bodies.angular_velocity = solution.velocity[:n, :3].copy(), solution.velocity[:n, 3:].copy()
        points.velocity = solution.velocity[n + 1 : ends, :3].copy()

        touched, held = np.zeros(len(system.ease), dtype=bool), np.zeros(len(system.ease), dtype=bool)
        pushed = solution.impulses[:, 0] != 0.0
        for axis in (1, 2):
            pushed |= solution.impulses[:, axis] != 0.0
        pushed |= impacts.impulses.any(axis=1)
        is_free = bodies.are_free(system.bodies)
        for side in range(2):
            touched[system.bodies[pushed, side]] = True
            held[system.bodies[pushed & ~is_free[:, 1 - side], side]] = True
        return Outcome(
            solution.extra[: n + 1],
            touched[:n],
            held[:n],
            solution.impulses / dt,
            impacts.iterations + solution.iterations,
            impacts.converged and solution.converged,
            by_joints + impacts.joint_impulses + solution.joint_impulses,
            impacts.impulses + solution.impulses,
        )

    def _resolve_pile(self, detector: CollisionDetector, bodies: MovingBodies, dt: float, ease: Array) -> Outcome:
        from sim.rigid.pile_kernels import Limits

        self._pile = self._pile or Pile(detector, len(bodies), in_colours=bool(self.in_colours))
        n = len(bodies)
        velocity = np.zeros((n + 1, 6))
        velocity[:n, :3], velocity[:n, 3:] = bodies.velocity, bodies.angular_velocity
        limits = Limits(
            RELATIVE_TOLERANCE,
            self._tolerance(dt),
            WEIGHT_TOLERANCE,
            MAX_ITERATIONS,
            COARSE_SPEED,
            0 if self.in_colours else COARSE_WORK,  # a sweep in colours takes as long of a small island as of all
            COARSE_CONTACTS,
            FEWEST_ITERATIONS,
            _rate(dt),
            SLOP,
            dt,
        )
        velocity, extra = self._pile.solve(ease, velocity, self._surfaces.friction, limits)
        bodies.velocity, bodies.angular_velocity = velocity[:n, :3].copy(), velocity[:n, 3:].copy()
        touched = self._pile.touched[:n]
        return Outcome(
            extra,
            touched > 0,
            touched > 1,
            None,
            self._pile.sweeps,
            self._pile.converged,
            NO_IMPULSES,
            np.zeros((0, 3)),
        )

    def _bounce(
        self,
        contacts: Contacts,
        bodies: MovingBodies,
        system: ContactSystem,
        velocity: Array,
        friction: Array,
        restitution: Array,
        least_normal: Array,
        dt: float,
        joints: JointDemand | None,
    ) -> tuple[Solution, Bounces]:
        """The impacts of a step in rounds: a blow goes through bodies that touch, or nearly, one after the other.

        In each round contacts that approach bounce at once, together with those that never do; what can bounce and does
        not approach is left out, so that it gets the blow in the next round (Smith, Kaufman, Vouga, Tamstorf &
        Grinspun 2012, "Reflections on simultaneous impact"). Velocities (v, omega) of all bodies [m/s], [rad/s] are
        those before, (n + 1, 6).
        """
        k = len(contacts)
        impulses, bounces = np.zeros((k, 3)), Bounces.none(k)
        by_joints = NO_IMPULSES if joints is None else np.zeros(len(joints.bias))
        if not restitution.any():
            return Solution(impulses, velocity, np.zeros_like(velocity), 0, True, by_joints), bounces
        iterations, converged = 0, True
        for rounds in range(MOST_ROUNDS + 1):
            found = Bounces.find(
                contacts,
                bodies,
                approach=system.along_normals(velocity),
                restitution=restitution,
                gravity=self._gravity,
                dt=dt,
            )
            if not found.happens.any():
                break
            if rounds == MOST_ROUNDS:
                converged = False
                break
            bounces = bounces.then(found)
            is_struck = np.zeros(int(system.islands.max()) + 1, dtype=bool)
            is_struck[system.islands[found.happens]] = True
            rows = np.flatnonzero(found.happens | ((restitution == 0.0) & is_struck[system.islands]))
            part = system.chosen(rows)
            solution = solve_impacts(
                part,
                velocity,
                bounces=found.chosen(rows),
                least_normal=least_normal[rows],
                friction=friction[rows],
                tolerance=self._tolerance(dt),
                joints=joints,
            )
            by_joints = by_joints + solution.joint_impulses
            impulses[rows] += solution.impulses
            velocity = solution.velocity
            iterations, converged = iterations + solution.iterations, converged and solution.converged
        return Solution(impulses, velocity, np.zeros_like(velocity), iterations, converged, by_joints), bounces

    def _tolerance(self, dt: float) -> float:
        """What a sweep may still change besides when it is the last [m/s]."""
        return WEIGHT_TOLERANCE * dt * float(np.linalg.norm(self._gravity))


def _separation(contacts: Contacts, bounces: Bounces, dt: float) -> Apart:
    """Overlaps shrink, and bounces end where they would have come to."""
    return Apart(contacts.gap, _rate(dt), SLOP, dt, bounces.is_placed, bounces.rest, bounces.fall, WEIGHT_TOLERANCE)


def _rate(dt: float) -> float:
    """At which overlaps shrink [1/s]."""
    return min(LARGEST_SEPARATION, -math.expm1(-dt / SEPARATION_TIME_S)) / dt
