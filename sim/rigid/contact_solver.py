"""Contact impulses: projected Gauss-Seidel on the impulses of all contacts, started from those of the last step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.rotation import cross
from sim.rigid.contacts import Array, Contacts, Indices
from sim.rigid.joint_system import JointDemand

MAX_ITERATIONS = 100
NO_LINKS, NO_IMPULSES = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
COARSE_SPEED = 0.05
COARSE_WORK, COARSE_CONTACTS, FEWEST_ITERATIONS = 15_000, 1.7, 14
"""Islands whose contacts are faster [m/s], in the mean, get the most of three numbers of sweeps: what makes so many
looks at contacts; s, if they have so many contacts times s³, as a heap is high; the least that any gets. What is left
of their overlap is far less than they move in the step. Half as many move large piles apart: overlaps come from what is
left of velocities."""
RELATIVE_TOLERANCE = 1.0e-6  # of the largest contact velocity: what one sweep may still change when it is the last


@dataclass(frozen=True, eq=False)
class Carried:
    """Sides of contacts on surfaces that deform: there they meet a point of the surface, which is led by it."""

    rows: Indices  # numbers of the contacts, (c,)
    sides: Indices  # 0 for the first body of each, 1 for the second
    velocity: Array  # of the surface [m/s], (c, 3)


NOT_CARRIED = Carried(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """The linear relation between impulses at contacts and velocities there.

    With the Jacobian J, mass matrix M and impulses λ the velocities at the contacts are w = A λ + b, A = J M⁻¹ Jᵀ,
    b = J v. A contact knows two bodies, so that A is sparse; it is never formed. Impulses in one island do not change
    velocities in another, through joints either.
    """

    point: Array  # [m], (k, 3)
    normal: Array  # from the second to the first, (k, 3)
    bodies: NDArray[np.int32]  # numbers of the two bodies, n where one does not belong to those that move, (k, 2)
    position: Array  # of the moving bodies, one that stands still, points, and c that surfaces carry [m], (b, 3)
    ease: Array  # of these, inverse mass and inertia: xx, xy, xz, yy, yz, zz, (b, 7)
    islands: Indices  # numbers of the groups of contacts that hang together, (k,)
    island_of_bodies: Indices  # likewise of bodies, -1 of those that no contact, or no impulse, moves, (b,)
    links: Indices  # pairs of bodies that joints link, (l, 2)

    @classmethod
    def build(
        cls,
        contacts: Contacts,
        position: Array,
        ease: Array,
        links: Indices = NO_LINKS,
        carried: Carried = NOT_CARRIED,
    ) -> ContactSystem:
        """The system of some contacts of n moving bodies, which come first in the numbering of bodies.

        How easily impulses move them is given, (b - c, 7), with one that stands still and the points of joints.
        """
        n, c, before = len(position), len(carried.rows), len(ease)
        bodies = np.minimum(np.stack([contacts.first, contacts.second], axis=1), n).astype(np.int32)
        bodies[carried.rows, carried.sides] = before + np.arange(c)
        ease = np.concatenate([ease, np.zeros((c, 7))])
        position = np.concatenate([position, np.zeros((before - n, 3)), contacts.point[carried.rows]])
        islands = _islands(bodies, ease[:, 0] > 0.0, links)
        return cls(contacts.point, contacts.normal, bodies, position, ease, *islands, links)

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Whether impulses move the two bodies of contacts, (k, 2)."""
        result: NDArray[np.bool_] = self.ease[self.bodies, 0] > 0.0
        return result

    def chosen(self, rows: Indices) -> ContactSystem:
        """The system of some of the contacts."""
        bodies = self.bodies[rows]
        islands = _islands(bodies, self.ease[:, 0] > 0.0, self.links)
        return ContactSystem(
            self.point[rows], self.normal[rows], bodies, self.position, self.ease, *islands, self.links
        )

    def most_sweeps(self, velocity: Array) -> NDArray[np.int32]:
        """How many sweeps each island is worth, (islands,), with velocities (v, omega) of all bodies, (n + 1, 6)."""
        sizes = np.bincount(self.islands)
        speeds = np.sqrt(np.square(velocity[:, :3]).sum(axis=1))[self.bodies]
        speed = np.maximum(speeds[:, 0], speeds[:, 1])
        is_coarse = np.bincount(self.islands, weights=speed) > COARSE_SPEED * sizes
        fewer = np.maximum(COARSE_WORK // sizes, np.ceil(np.cbrt(sizes / COARSE_CONTACTS)))
        fewer = fewer.clip(FEWEST_ITERATIONS, MAX_ITERATIONS)
        return np.where(is_coarse, fewer, MAX_ITERATIONS).astype(np.int32)

    def velocities(self, of_bodies: Array) -> Array:
        """Relative velocities at the contacts [m/s], (k, 3), of velocities (v, omega) of all bodies, (n + 1, 6)."""
        both = of_bodies[self.bodies]
        at = both[..., :3] + cross(both[..., 3:], self.point[:, None] - self.position[self.bodies])
        result: Array = at[:, 0] - at[:, 1]
        return result

    def along_normals(self, of_bodies: Array) -> Array:
        """Of these velocities that along the normals [m/s], (k,)."""
        return np.einsum("ki,ki->k", self.normal, self.velocities(of_bodies))


@dataclass(frozen=True, eq=False)
class Apart:
    """What moves bodies apart that overlap, and where bounces end, in a step: fields of `contact_kernels.Overlaps`."""

    gap: Array  # [m], (k,)
    rate: float  # at which overlaps shrink [1/s]
    slop: float  # overlap that stays [m]
    dt: float  # [s]
    is_placed: NDArray[np.bool_]  # contacts that are brought to where their bounce leads to, (k,)
    rest: Array  # time from the bounce to the end of the step [s], (k,)
    fall: Array  # velocity that gravity adds in that time along the normal [m/s], (k,)
    tolerance: float  # largest change in the last sweep, in the largest velocity that is wanted in the island


@dataclass(frozen=True, eq=False)
class Solution:
    """Impulses and how they were found."""

    impulses: Array  # [N s], (k, 3)
    velocity: Array  # (v, omega) of all bodies with them [m/s], [rad/s], (n + 1, 6)
    extra: Array  # likewise, what only moves them apart
    iterations: int  # sweeps over all contacts of the island that took most
    converged: bool  # whether the last sweep changed less than the tolerance, in all islands
    joint_impulses: Array  # those of joints, (r,), or none where these ask nothing


def solve_velocities(
    system: ContactSystem,
    velocity: Array,
    *,
    least_normal: Array,
    friction: Array,
    start: Array,
    relative_tolerance: float,
    tolerance: float,
    most: NDArray[np.int32] | None = None,
    joints: JointDemand | None = None,
    apart: Apart | None = None,
) -> Solution:
    """Impulses with w_n >= least_normal, λ_n >= 0, complementary, and Coulomb friction |λ_t| <= mu λ_n.

    Sweeps over contacts, there and back; of each, first the normal impulse, then both tangential ones exactly for that
    normal one (nonsmooth Gauss-Seidel; Jean 1999, "The non-smooth contact dynamics method"): they stop the slip if
    friction is strong enough, else they are as large as it allows, and opposite to the slip that is left.

    Args:
        system: of the contacts, those of two bodies one after the other.
        velocity: (v, omega) of all bodies without the impulses of these contacts [m/s], [rad/s], (n + 1, 6).
        least_normal: lower bound of the normal velocities [m/s], (k,).
        friction: coefficients mu [-], (k,).
        start: impulses to start from [N s], (k, 3).
        relative_tolerance: largest change of a contact velocity in the last sweep, in the largest one of the island.
        tolerance: what may change besides [m/s].
        most: sweeps of each island, (islands,); if omitted, the most that there are.
        joints: what joints ask, of which those in islands with contacts are solved.
        apart: what moves bodies apart, in a solve of its own by normal impulses, as many sweeps at most.
    """
    from sim.rigid.contact_kernels import (
        COLUMNS,
        Islands,
        Outcomes,
        Overlaps,
        System,
        solve_islands,
        solve_jointed_islands,
    )
    from sim.rigid.joint_kernels import IMPULSE

    k, count = len(least_normal), int(system.islands.max()) + 1
    most = np.full(count, MAX_ITERATIONS, dtype=np.int32) if most is None else most
    begins = np.flatnonzero(np.append(True, (system.bodies[1:] != system.bodies[:-1]).any(axis=1)))
    sizes = np.diff(begins, append=k)
    # By chance, but always the same: along rows of bodies sweeps carry what they leave to one side.
    pairs = np.lexsort((np.random.PCG64(0).random_raw(len(begins)), system.islands[begins]))
    spans = np.append(0, np.cumsum(sizes[pairs]))
    order = np.repeat(begins[pairs] - spans[:-1], sizes[pairs]) + np.arange(k)
    movers = np.argsort(system.island_of_bodies, kind="stable")[np.count_nonzero(system.island_of_bodies < 0) :]
    numbers = np.arange(count + 1)
    islands = Islands(
        *(
            each.astype(np.int32)
            for each in (
                order,
                spans,
                np.searchsorted(system.islands[begins[pairs]], numbers),
                movers,
                np.searchsorted(system.island_of_bodies[movers], numbers),
                most,
            )
        )
    )
    contacts = System(system.bodies, system.point, system.normal, least_normal, friction, system.position, system.ease)
    nothing = np.zeros(k)
    asked = apart or Apart(nothing, 0.0, 0.0, 1.0, np.zeros(k, dtype=bool), nothing, nothing, 0.0)
    overlaps = Overlaps(
        asked.gap, asked.rate, asked.slop, asked.dt, asked.is_placed.astype(np.int32), asked.rest, asked.fall
    )
    found = Outcomes(
        start.copy(),
        velocity.copy(),
        np.empty(k),
        np.zeros_like(velocity),
        np.zeros((count, 2), dtype=np.int32),
        np.empty((k, COLUMNS)),
        np.empty((len(velocity), 12)),
    )
    limits = (relative_tolerance, tolerance, asked.tolerance, overlaps, found)
    by_joints = NO_IMPULSES
    if joints is None:
        solve_islands(islands, contacts, *limits)
    else:
        rows = joints.rows()
        solve_jointed_islands(islands, contacts, *_joints_of_islands(system, joints), rows, *limits)
        by_joints = rows.numbers[:, IMPULSE].copy()
    taken = int(np.minimum(found.sweeps, MAX_ITERATIONS).max(axis=0).sum())
    converged = bool(np.all((found.sweeps <= most[:, None]) | (most[:, None] < MAX_ITERATIONS)))
    return Solution(found.impulses, found.velocity, found.extra, taken, converged, by_joints)


def _islands(bodies: NDArray[np.int32], moves: NDArray[np.bool_], links: Indices) -> tuple[Indices, Indices]:
    """Numbers of the groups of contacts, (k,), and of bodies, (n + 1,), which impulses move, that joints link too."""
    from sim.rigid.contact_kernels import join_bodies

    first, second = bodies.T
    group = np.arange(len(moves), dtype=np.int32)
    join_bodies(bodies, links.astype(np.int32), moves.astype(np.int32), group)
    of_contacts = group[np.where(moves[first], first, second)]
    number = np.full(len(moves), -1)
    number[of_contacts] = 0
    number[number == 0] = np.arange(np.count_nonzero(number == 0))
    return number[of_contacts], np.where(moves, number[group], -1)


def _joints_of_islands(system: ContactSystem, joints: JointDemand) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Components of joints, island after island, and where those of each island begin; others are left out."""
    elimination, movers = joints.system.elimination, joints.system.movers.max(axis=1)
    island, moved = np.full(len(elimination.components), -1), movers >= 0
    island[elimination.component[moved]] = system.island_of_bodies[movers[moved]]
    order = np.argsort(island, kind="stable").astype(np.int32)
    begins = np.searchsorted(island[order], np.arange(int(system.islands.max()) + 2)).astype(np.int32)
    return order, begins
