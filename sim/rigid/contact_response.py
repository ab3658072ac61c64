"""What contacts do to bodies in a step: impacts, resting, friction, and moving overlapping bodies apart."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.solver import Arrays
from sim.rigid.contact_solver import (
    NO_IMPULSES,
    NO_LINKS,
    RELATIVE_TOLERANCE,
    ContactSystem,
    Solution,
    solve_velocities,
)
from sim.rigid.contacts import Array, Contacts, Indices, bodies_of, rows_of
from sim.rigid.joint_system import UNBOUNDED, JointDemand, solve_alone
from sim.rigid.joints import Joints, JointStep
from sim.rigid.restitution import Bounces, solve_impacts
from sim.rigid.states import MovingBodies

SEPARATION_TIME_S, LARGEST_SEPARATION = 0.02, 0.2  # in which overlaps decay, and by what share a step at most
SLOP = 1.0e-6  # overlap that stays [m]: below what anybody sees, above what rounding makes
MOST_ROUNDS = 50  # of impacts in a step; after them what still approaches no longer bounces
WEIGHT_TOLERANCE = 1.0e-4  # of the speed that gravity gives in a step: what the last sweep may still change

BodiesOf = Callable[[Indices], tuple[Indices, Indices]]


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

    extra_velocity: Array  # added to the velocity in this step's change of poses only [m/s], (n, 3)
    extra_angular_velocity: Array  # [rad/s], (n, 3)
    is_touched: NDArray[np.bool_]  # bodies that got an impulse, (n,) bool
    is_held: NDArray[np.bool_]  # bodies that got one from what cannot move, (n,) bool
    iterations: int  # sweeps of the solver
    converged: bool  # whether it converged
    joint_impulses: Array  # of the joints, (r,), if there are any
    impulses: Array  # of the contacts on their first bodies, impacts included [N s], (k, 3)


class ContactResponse:
    """Resolves the contacts of a step, starting from the forces of the step before; gravity is in m/s².

    Attributes:
        last_keys: the contacts of the last step, ascending.
    """

    def __init__(self, surfaces: Surfaces, gravity: Array, movers_of: BodiesOf = bodies_of) -> None:
        """Take also what tells of which bodies contacts are, by their keys."""
        self._surfaces, self._gravity, self._movers_of = surfaces, gravity, movers_of
        self._keep(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))

    def resolve(
        self,
        contacts: Contacts,
        bodies: MovingBodies,
        dt: float,
        is_active: NDArray[np.bool_],
        inverse_inertia: Array,
        joints: Joints | None = None,
        step: JointStep | None = None,
    ) -> Outcome:
        """Change the velocities of active bodies, (n,), so that contacts hold, bounce and rub over a step of dt [s].

        These are all their contacts; what is known of those of other bodies stays. Inverse inertia tensors are in world
        axes, (n, 3, 3); joints, with their step, hold where contacts are.

        A contact with a gap may close within the step: w_n >= -gap / dt (speculative, so that nothing tunnels).
        """
        n = len(bodies)
        if not len(contacts):
            self._replace(contacts.keys, np.zeros((0, 3)), is_active)
            nobody = np.zeros(n, dtype=bool)
            still = np.zeros(0 if step is None else len(step.values))
            return Outcome(np.zeros((n, 3)), np.zeros((n, 3)), nobody, nobody.copy(), 0, True, still, np.zeros((0, 3)))
        inverse_mass = np.where(is_active, bodies.inverse_mass, 0.0)
        links = NO_LINKS if step is None else step.system.links()
        system = ContactSystem.build(contacts, bodies.position, inverse_mass, inverse_inertia, links)
        friction, restitution = self._surfaces.of_pairs(contacts.first, contacts.second)
        least_normal = -np.maximum(contacts.gap, 0.0) / dt
        before = np.zeros((n + 1, 6))
        before[:n, :3], before[:n, 3:] = bodies.velocity, bodies.angular_velocity
        of_impacts, of_step, by_joints = None, None, NO_IMPULSES
        if joints is not None and step is not None:
            of_impacts, of_step = joints.impacts(step), joints.velocities(step)
            alone = solve_alone(of_impacts, before)  # impacts are of bodies that the joints hold already
            before, by_joints = alone.velocity, alone.impulses
        impacts, bounces = self._bounce(
            contacts, bodies, system, before, friction, restitution, least_normal, dt, of_impacts
        )
        most = system.most_sweeps(before)
        solution = solve_velocities(
            system,
            impacts.velocity,
            least_normal=least_normal,
            friction=friction,
            start=self._starting_impulses(contacts, dt),
            relative_tolerance=RELATIVE_TOLERANCE,
            tolerance=self._tolerance(dt),
            joints=of_step,
            most=most,
        )
        bodies.velocity, bodies.angular_velocity = solution.velocity[:n, :3], solution.velocity[:n, 3:]
        self._replace(contacts.keys, solution.impulses / dt, is_active)

        separation = self._separate(contacts, system, bounces, solution.along_normals, dt, most)
        touched, held = np.zeros(n + 1, dtype=bool), np.zeros(n + 1, dtype=bool)
        pushed = solution.impulses.any(axis=1) | impacts.impulses.any(axis=1)
        for body, other in ((contacts.first, contacts.second), (contacts.second, contacts.first)):
            touched[np.minimum(body[pushed], n)] = True
            held[np.minimum(body[pushed & ~bodies.are_free(other)], n)] = True
        return Outcome(
            separation.velocity[:n, :3],
            separation.velocity[:n, 3:],
            touched[:n],
            held[:n],
            impacts.iterations + solution.iterations + separation.iterations,
            impacts.converged and solution.converged and separation.converged,
            by_joints + impacts.joint_impulses + solution.joint_impulses,
            impacts.impulses + solution.impulses,
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
            return Solution(impulses, velocity, np.zeros(k), 0, True, by_joints), bounces
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
        return Solution(impulses, velocity, np.zeros(k), iterations, converged, by_joints), bounces

    def _tolerance(self, dt: float) -> float:
        """What a sweep may still change besides when it is the last [m/s]."""
        return WEIGHT_TOLERANCE * dt * float(np.linalg.norm(self._gravity))

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The forces that the next step starts from."""
        return {"contact_keys": self.last_keys.copy(), "contact_forces": self._forces.copy()}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing."""
        for name in ("contact_keys", "contact_forces"):
            if name not in arrays:
                raise ValueError(f"checkpoint of the rigid bodies: {name} is missing")
        keys, forces = np.asarray(arrays["contact_keys"]), np.asarray(arrays["contact_forces"])
        self._keep(keys.astype(np.int64), forces.astype(np.float64).reshape(-1, 3))

    def _replace(self, keys: Indices, forces: Array, is_active: NDArray[np.bool_]) -> None:
        """Keep the forces of the contacts of active bodies, and those that were known of other bodies."""
        first, second = self._movers_of(self.last_keys)
        among = np.append(is_active, False)
        stays = ~(among[np.minimum(first, len(is_active))] | among[np.minimum(second, len(is_active))])
        self._keep(np.concatenate([keys, self.last_keys[stays]]), np.concatenate([forces, self._forces[stays]]))

    def _keep(self, keys: Indices, forces: Array) -> None:
        order = np.argsort(keys)
        self.last_keys, self._forces = keys[order], forces[order]

    def _starting_impulses(self, contacts: Contacts, dt: float) -> Array:
        """The forces at the same contacts in the last step times dt [s], (k, 3)."""
        if not len(self.last_keys):
            return np.zeros((len(contacts), 3))
        rows, is_known = rows_of(contacts.keys, self.last_keys)
        return np.where(is_known[:, None], dt * self._forces[rows], 0.0)

    def _separate(
        self,
        contacts: Contacts,
        system: ContactSystem,
        bounces: Bounces,
        normal_velocity: Array,
        dt: float,
        most: NDArray[np.int32],
    ) -> Solution:
        """Velocities that only move poses: overlaps shrink, and bounces end where they would have come to."""
        k, overlap, rest = len(contacts), -contacts.gap - SLOP, np.zeros((len(system.ease), 6))
        if not np.any(bounces.is_placed) and not np.any(overlap > 0.0):
            return Solution(np.zeros((k, 3)), rest, np.zeros(k), 0, True, NO_IMPULSES)
        rate = min(LARGEST_SEPARATION, -math.expm1(-dt / SEPARATION_TIME_S)) / dt
        # Contacts that do not overlap may close by what the velocities leave of their gaps.
        wanted = np.where(overlap > 0.0, rate * overlap, -np.maximum(contacts.gap, 0.0) / dt - normal_velocity)
        wanted = np.where(overlap > 0.0, wanted, np.minimum(wanted, 0.0))
        wanted = np.where(
            bounces.is_placed, bounces.displacement(normal_velocity, contacts.gap) / dt - normal_velocity, wanted
        )
        return solve_velocities(
            system,
            rest,
            least_normal=wanted,
            friction=np.zeros(k),
            start=np.zeros((k, 3)),
            relative_tolerance=WEIGHT_TOLERANCE,
            tolerance=0.0,
            lowest=np.where(bounces.is_placed, -UNBOUNDED, 0.0),
            most=most,
        )
