"""Impacts: which contacts bounce, and how much of the energy that they take they give back."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sim.rigid.contact_solver import RELATIVE_TOLERANCE, ContactSystem, Solution, solve_velocities
from sim.rigid.contacts import Array, Contacts, Indices
from sim.rigid.joint_system import JointDemand
from sim.rigid.states import MovingBodies

SLOWEST_BOUNCE = 0.02  # approach below which nothing bounces [m/s]; or two steps of gravity


@dataclass(frozen=True, eq=False)
class Bounces:
    """The impacts among contacts, (k,) each."""

    happens: NDArray[np.bool_]  # whether the contact bounces
    is_placed: NDArray[np.bool_]  # whether it is brought to where its bounce leads to by the end of the step
    restitution: Array  # speed after over speed before [-]; 0 where nothing bounces
    impact: Array  # normal velocity right before the impact [m/s]
    rest: Array  # time from the impact to the end of the step [s]
    fall: Array  # normal velocity that gravity adds in that time [m/s]

    @classmethod
    def find(
        cls, contacts: Contacts, bodies: MovingBodies, *, approach: Array, restitution: Array, gravity: Array, dt: float
    ) -> Bounces:
        """Contacts that close within the step fast enough to bounce.

        Against what cannot move the instant of the impact counts, as gravity acts before and after it: else a ball
        would come back to e² h0 only to first order in dt. Between free bodies gravity cancels, and an impulse at the
        start of the step keeps all momenta exactly. The approach is the normal velocity with all of the step's gravity,
        without impulses [m/s], (k,).
        """
        first_free, second_free = bodies.are_free(contacts.first), bodies.are_free(contacts.second)
        one_sided = first_free != second_free
        pull = contacts.normal @ gravity
        acceleration = np.where(first_free, pull, 0.0) - np.where(second_free, pull, 0.0)
        gap = np.maximum(contacts.gap, 0.0)
        before = approach - dt * acceleration
        under_root = before**2 - 2.0 * acceleration * gap
        falls = -before + np.sqrt(np.maximum(under_root, 0.0))
        hits = (under_root >= 0.0) & (falls > 0.0)
        time_s = np.where(hits, 2.0 * gap / np.where(hits, falls, 1.0), np.inf)
        hits &= time_s <= dt
        time_s = np.where(hits, time_s, 0.0)
        impact = before + acceleration * time_s
        happens = hits & (restitution > 0.0) & (impact < -slowest_bounce(gravity, dt))
        rest = np.where(happens, dt - time_s, 0.0)
        return cls(
            happens=happens,
            is_placed=happens & one_sided & (contacts.gap > 0.0),
            restitution=np.where(happens, restitution, 0.0),
            impact=impact,
            rest=rest,
            fall=acceleration * rest,
        )

    @classmethod
    def none(cls, count: int) -> Bounces:
        """No impacts, at so many contacts."""
        no, zero = np.zeros(count, dtype=bool), np.zeros(count)
        return cls(no, no, zero, zero, zero, zero)

    def then(self, later: Bounces) -> Bounces:
        """These impacts, but the later ones at contacts that have one."""
        pairs = ((getattr(self, field.name), getattr(later, field.name)) for field in fields(self))
        return Bounces(*(np.where(later.happens, after, before) for before, after in pairs))

    def chosen(self, rows: Indices) -> Bounces:
        """Those at some of the contacts."""
        return Bounces(*(getattr(self, field.name)[rows] for field in fields(self)))

    def least_velocity(self, otherwise: Array, *, share: float) -> Array:
        """Least normal velocities at the end of the step [m/s], (k,), `otherwise` where contacts do not bounce.

        `share` is that of the restitution: 1 as it is, 0 for the state in which the bodies no longer approach.
        """
        return np.where(self.happens, self.fall - share * self.restitution * self.impact, otherwise)


def slowest_bounce(gravity: Array, dt: float) -> float:
    """Approach below which nothing bounces in a step of dt [s]; gravity is in m/s²."""
    return max(SLOWEST_BOUNCE, 2.0 * dt * float(np.linalg.norm(gravity)))


def solve_impacts(
    system: ContactSystem,
    velocity: Array,
    *,
    bounces: Bounces,
    least_normal: Array,
    friction: Array,
    tolerance: float,
    joints: JointDemand | None = None,
) -> Solution:
    """Impulses with Newton's restitution, as far as energy allows; arguments as those of `solve_velocities`.

    Newton's law w_n = -e b_n is of velocities. Together with friction, or with other contacts, the impulses that it
    takes may do work on the bodies (Kane & Levinson 1985): 29 % of the energy that a cube brings, at e = 1. Stronge's
    law (1990) is of energy: restitution gives back e² of what compression took by normal impulses. Here it is a
    bound. With the impulses λ0 at which nothing approaches any more (the end of compression) and λ1, Newton's, the
    work on the bodies of λ = λ0 + s (λ1 - λ0) is a convex polynomial E(s) of second degree, and s <= 1 is the largest
    with

        E(s) <= min(0, E(0) + sum_i e_i² |W_i|),    W_i = λ0_n (b_n + w0_n)/2 the work of a normal impulse.

    λ is between two solutions: it pushes only, stays within friction and lets nothing approach, which are all convex.
    Without friction E(1) is just the bound, as it is for all central impacts, so that Newton's law holds there. Each
    group of bodies that touch has its own s. Joints, which do no work, hold throughout.
    """
    solve = partial(
        solve_velocities,
        system,
        velocity,
        friction=friction,
        relative_tolerance=RELATIVE_TOLERANCE,
        tolerance=tolerance,
        joints=joints,
    )
    nothing = np.zeros((len(least_normal), 3))
    compression = solve(least_normal=bounces.least_velocity(least_normal, share=0.0), start=nothing)
    before = compression.impulses
    newton = solve(
        least_normal=bounces.least_velocity(least_normal, share=1.0),
        start=(1.0 + bounces.restitution)[:, None] * before,
    )
    islands = system.islands
    step = newton.impulses - before
    # Mean velocity while an impulse acts, at the instant of the impact.
    mean_before = 0.5 * system.velocities(velocity + compression.velocity) - bounces.fall[:, None] * system.normal
    change_of_bodies = newton.velocity - compression.velocity
    change = system.velocities(change_of_bodies)
    pressing = np.einsum("ki,ki->k", before, system.normal) * np.einsum("ki,ki->k", mean_before, system.normal)
    work_before, linear, quadratic = (
        np.bincount(islands, weights=terms)
        for terms in (
            np.sum(before * mean_before, axis=1),
            np.sum(step * mean_before, axis=1) + 0.5 * np.sum(before * change, axis=1),
            0.5 * np.sum(step * change, axis=1),
        )
    )
    returned = -np.bincount(islands, weights=bounces.restitution**2 * pressing)
    most = np.maximum(np.minimum(work_before + returned, 0.0), work_before)
    share = np.array([_largest_share(*each) for each in zip(most - work_before, linear, quadratic, strict=True)])
    # Of bodies that no impulse moves nothing changes, whatever their share.
    share_of_bodies, moves = np.zeros(len(velocity)), system.moves
    for side in range(2):
        share_of_bodies[system.bodies[moves[:, side], side]] = share[islands[moves[:, side]]]
    by_joints = compression.joint_impulses
    if joints is not None:
        share_of_bodies, share_of_rows = _shares_with_joints(share_of_bodies, joints)
        by_joints = by_joints + share_of_rows * (newton.joint_impulses - by_joints)
    return Solution(
        before + share[islands][:, None] * step,
        compression.velocity + share_of_bodies[:, None] * change_of_bodies,
        np.zeros_like(velocity),
        compression.iterations + newton.iterations,
        compression.converged and newton.converged,
        by_joints,
    )


def _shares_with_joints(share_of_bodies: Array, joints: JointDemand) -> tuple[Array, Array]:
    """The shares of all bodies, (n + 1,), with those that joints alone move, and of rows of joints, (r,).

    All bodies of a component of joints are of one island, and at least one of those that contacts move knows its share.
    """
    movers, elimination = joints.system.movers, joints.system.elimination
    of_components, shares = np.zeros(len(elimination.components)), share_of_bodies.copy()
    sides = [(movers[:, side][movers[:, side] >= 0], elimination.component[movers[:, side] >= 0]) for side in range(2)]
    for moved, component in sides:
        np.maximum.at(of_components, component, share_of_bodies[moved])
    for moved, component in sides:
        shares[moved] = of_components[component]
    return shares, of_components[elimination.component]


def _largest_share(room: float, linear: float, quadratic: float) -> float:
    """The largest s in [0, 1] with linear s + quadratic s² <= room, for room >= 0 and quadratic >= 0."""
    if linear + quadratic <= room:
        return 1.0
    root = math.sqrt(linear**2 + 4.0 * quadratic * room)
    # Of the two forms of the root, that which does not subtract nearly equal numbers.
    return 2.0 * room / (linear + root) if linear > 0.0 else (root - linear) / (2.0 * quadratic)
