"""Contact impulses: projected Gauss-Seidel on the impulses of all contacts, started from those of the last step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sim.core.motion.rotation import cross
from sim.rigid.contacts import Array, Contacts, Indices
from sim.rigid.joint_system import UNBOUNDED, JointDemand

MAX_ITERATIONS = 100
NO_LINKS, NO_IMPULSES = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
RELATIVE_TOLERANCE = 1.0e-6  # of the largest contact velocity: what one sweep may still change when it is the last


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """The linear relation between impulses at contacts and velocities there.

    Contact i has three rows: the normal and two tangents. With the Jacobian J, mass matrix M and impulses λ the
    velocities at the contacts are w = A λ + b, A = J M⁻¹ Jᵀ, b = J v. A contact knows two bodies, so that A is sparse;
    it is never formed. Impulses in one island do not change velocities in another, through joints either.
    """

    axes: Array  # normal and tangents, (k, 3, 3)
    bodies: Indices  # numbers of the two bodies, n where one does not belong to those that move, (k, 2)
    movers: NDArray[np.int32]  # likewise, -1 where no impulse moves it
    jacobian: Array  # of the velocities (v, omega) of the two bodies, (k, 2, 3, 6)
    response: Array  # M⁻¹ Jᵀ, transposed, (k, 2, 3, 6)
    own: Array  # the contact's own block of A: nn, n1, n2, 11, 12, 22, (k, 6)
    islands: Indices  # numbers of the groups of contacts that hang together, (k,)
    body_count: int  # n
    links: Indices  # pairs of bodies that joints link, (l, 2)

    @classmethod
    def build(
        cls, contacts: Contacts, position: Array, inverse_mass: Array, inverse_inertia: Array, links: Indices = NO_LINKS
    ) -> ContactSystem:
        """The system of some contacts of n moving bodies, which come first in the numbering of bodies."""
        k, n = len(contacts), len(position)
        axes = np.concatenate([contacts.normal[:, None], tangent_basis(contacts.normal)], axis=1)
        bodies = np.minimum(np.stack([contacts.first, contacts.second], axis=1), n)
        moves = np.append(inverse_mass > 0.0, False)[bodies]
        number = np.where(bodies < n, bodies, 0)
        arm = contacts.point[:, None] - position[number]
        sign = np.where(bodies < n, np.array([1.0, -1.0]), 0.0)[:, :, None, None]
        jacobian = np.empty((k, 2, 3, 6))
        jacobian[..., :3] = sign * axes[:, None]
        jacobian[..., 3:] = sign * cross(arm[:, :, None], axes[:, None])
        response = np.empty_like(jacobian)
        response[..., :3] = jacobian[..., :3] * inverse_mass[number][:, :, None, None]
        inertia = np.where(moves[:, :, None, None], inverse_inertia[number], 0.0)
        response[..., 3:] = np.einsum("kscj,ksij->ksci", jacobian[..., 3:], inertia)
        blocks = np.einsum("ksci,ksdi->kcd", jacobian, response)
        own = np.ascontiguousarray(blocks[:, *np.triu_indices(3)])
        movers = np.where(moves, bodies, -1).astype(np.int32)
        return cls(axes, bodies, movers, jacobian, response, own, _islands(movers, n, links), n, links)

    def chosen(self, rows: Indices) -> ContactSystem:
        """The system of some of the contacts."""
        movers = self.movers[rows]
        return ContactSystem(
            self.axes[rows],
            self.bodies[rows],
            movers,
            self.jacobian[rows],
            self.response[rows],
            self.own[rows],
            _islands(movers, self.body_count, self.links),
            self.body_count,
            self.links,
        )

    def velocities(self, of_bodies: Array) -> Array:
        """Velocities at the contacts, (k, 3), of velocities (v, omega) of the moving bodies, (n, 6)."""
        both = np.concatenate([of_bodies, np.zeros((1, 6))])[self.bodies]
        return np.einsum("ksci,ksi->kc", self.jacobian, both)

    def largest_of_islands(self, values: Array) -> Array:
        """The largest value at the contacts of each island, none below 0, (islands,), of (k,)."""
        largest = np.zeros(int(self.islands.max(initial=-1)) + 1)
        np.maximum.at(largest, self.islands, values)
        return largest


@dataclass(frozen=True, eq=False)
class Solution:
    """Impulses and how they were found."""

    impulses: Array  # along the axes of the contacts [N s], (k, 3)
    change: Array  # of the velocities (v, omega) of the moving bodies by them, (n, 6)
    iterations: int  # sweeps over all contacts of the island that took most
    converged: bool  # whether the last sweep changed less than the tolerance, in all islands
    joint_impulses: Array  # those of joints, (r,), or none where these ask nothing


def solve_velocities(
    system: ContactSystem,
    free: Array,
    *,
    least_normal: Array,
    friction: Array,
    start: Array,
    tolerance: Array,
    joints: JointDemand | None = None,
) -> Solution:
    """Impulses with w_n >= least_normal, λ_n >= 0, complementary, and Coulomb friction |λ_t| <= mu λ_n.

    Sweeps over contacts, there and back; of each, first the normal impulse, then both tangential ones exactly for that
    normal one (nonsmooth Gauss-Seidel; Jean 1999, "The non-smooth contact dynamics method"): they stop the slip if
    friction is strong enough, else they are as large as it allows, and opposite to the slip that is left.

    Args:
        system: of the contacts.
        free: velocities at the contacts without their impulses [m/s], (k, 3).
        least_normal: lower bound of the normal velocities [m/s], (k,).
        friction: coefficients mu [-], (k,).
        start: impulses to start from [N s], (k, 3).
        tolerance: largest change of a contact velocity in the last sweep of each island [m/s], (islands,).
        joints: what joints ask, of which those in islands with contacts are solved.
    """
    bias = free.copy()
    bias[:, 0] -= least_normal
    return _sweep(system, bias, np.zeros(len(free)), friction, _admissible(start, friction), tolerance, joints)


def solve_positions(
    system: ContactSystem, wanted: Array, *, two_sided: NDArray[np.bool_], tolerance: Array
) -> Solution:
    """Normal impulses of a motion that moves bodies apart and leaves their velocities alone.

    Args:
        system: of the contacts.
        wanted: normal velocities of that motion [m/s], (k,): at least so much, or just so much.
        two_sided: contacts that get just that, (k,).
        tolerance: largest change of a contact velocity in the last sweep of each island [m/s], (islands,).
    """
    k = len(wanted)
    bias = np.zeros((k, 3))
    bias[:, 0] = -wanted
    return _sweep(system, bias, np.where(two_sided, -UNBOUNDED, 0.0), np.zeros(k), np.zeros((k, 3)), tolerance)


def tangent_basis(normal: Array) -> Array:
    """Two unit tangents a normal, (k, 2, 3), that depend on it continuously but at one pole (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = np.empty((len(normal), 2, 3))
    tangents[:, 0, 0], tangents[:, 0, 1], tangents[:, 0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    tangents[:, 1, 0], tangents[:, 1, 1], tangents[:, 1, 2] = b, sign + y * y * a, -y
    return tangents


def _sweep(
    system: ContactSystem,
    bias: Array,
    lowest: Array,
    friction: Array,
    impulses: Array,
    tolerance: Array,
    joints: JointDemand | None = None,
) -> Solution:
    """Impulses from those given on, which are overwritten."""
    from sim.rigid.contact_kernels import System, sweep_islands, sweep_jointed_islands
    from sim.rigid.joint_kernels import IMPULSE

    k = len(bias)
    order = np.argsort(system.islands, kind="stable").astype(np.int32)
    first = np.concatenate([[0], np.cumsum(np.bincount(system.islands))]).astype(np.int32)
    change, sweeps = np.zeros((system.body_count, 6)), np.zeros(len(first) - 1, dtype=np.int32)
    contacts = System(
        system.movers,
        system.jacobian.reshape(k, 36),
        system.response.reshape(k, 36),
        system.own,
        bias,
        lowest,
        friction,
    )
    found = (tolerance, MAX_ITERATIONS, impulses, change, np.empty((k, 6)), sweeps)
    by_joints = NO_IMPULSES
    if joints is None:
        sweep_islands(order, first, contacts, *found)
    else:
        rows = joints.rows()
        sweep_jointed_islands(order, first, contacts, *_joints_of_islands(system, joints), rows, *found)
        by_joints = rows.numbers[:, IMPULSE].copy()
    most = int(sweeps.max())
    return Solution(impulses, change, min(most, MAX_ITERATIONS), most <= MAX_ITERATIONS, by_joints)


def _islands(movers: NDArray[np.int32], n: int, links: Indices) -> Indices:
    """Numbers of the groups of contacts, (k,), that joints and bodies which impulses move link."""
    return np.unique(_groups(movers, n, links)[movers.max(axis=1)], return_inverse=True)[1].astype(np.int64)


def _groups(movers: NDArray[np.int32], n: int, links: Indices) -> Indices:
    """Number of the group of each body, (n,), that contacts and joints link."""
    first, second = np.concatenate([movers[(movers >= 0).all(axis=1)], links]).T
    linked = coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(n, n))
    return connected_components(linked, directed=False)[1].astype(np.int64)


def _joints_of_islands(system: ContactSystem, joints: JointDemand) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Components of joints, island after island, and where those of each island begin; others are left out."""
    groups = _groups(system.movers, system.body_count, system.links)
    island_of = np.full(system.body_count, -1)
    island_of[groups[system.movers.max(axis=1)]] = system.islands
    components, movers = joints.system.elimination.component, joints.system.movers.max(axis=1)
    island = np.full(len(joints.system.elimination.components), -1)
    moved = movers >= 0
    island[components[moved]] = island_of[groups[movers[moved]]]
    order = np.argsort(island, kind="stable").astype(np.int32)
    first = np.searchsorted(island[order], np.arange(int(system.islands.max()) + 2)).astype(np.int32)
    return order, first


def _admissible(impulses: Array, friction: Array) -> Array:
    """Impulses with the normal one not negative and the tangential ones within friction."""
    normal = np.maximum(impulses[:, 0], 0.0)
    size = np.sqrt(np.square(impulses[:, 1:]).sum(axis=1))
    limit = friction * normal
    share = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    return np.concatenate([normal[:, None], share[:, None] * impulses[:, 1:]], axis=1)
