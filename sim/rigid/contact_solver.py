"""Contact impulses: projected Gauss-Seidel on the impulses of all contacts, started from those of the last step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sim.core.motion.rotation import cross
from sim.rigid.contacts import Array, Contacts, Indices

MAX_ITERATIONS = 100
LARGEST_IMPULSE = 1.0e300  # [N s]: kernels know no infinity
RELATIVE_TOLERANCE = 1.0e-6  # of the largest contact velocity: what one sweep may still change when it is the last


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """The linear relation between impulses at contacts and velocities there.

    Contact i has three rows: the normal and two tangents. With the Jacobian J, mass matrix M and impulses λ the
    velocities at the contacts are w = A λ + b, A = J M⁻¹ Jᵀ, b = J v. A contact knows two bodies, so that A is sparse;
    it is never formed. Impulses in one island do not change velocities in another.
    """

    axes: Array  # normal and tangents, (k, 3, 3)
    bodies: Indices  # numbers of the two bodies, n where one does not belong to those that move, (k, 2)
    movers: NDArray[np.int32]  # likewise, -1 where no impulse moves it
    arms: Array  # from the centres of mass of the two bodies [m], (k, 2, 3)
    ease: Array  # inverse mass and inertia of the moving bodies: xx, xy, xz, yy, yz, zz, (n, 7)
    islands: Indices  # numbers of the groups of contacts that hang together, (k,)

    @classmethod
    def build(cls, contacts: Contacts, position: Array, inverse_mass: Array, inverse_inertia: Array) -> ContactSystem:
        """The system of some contacts of n moving bodies, which come first in the numbering of bodies."""
        n = len(position)
        bodies = np.minimum(np.stack([contacts.first, contacts.second], axis=1), n)
        movers = np.where(np.append(inverse_mass > 0.0, False)[bodies], bodies, -1).astype(np.int32)
        axes = np.concatenate([contacts.normal[:, None], tangent_basis(contacts.normal)], axis=1)
        # What does not belong to those that move stands still: its arm does not matter.
        arms = contacts.point[:, None] - np.concatenate([position, np.zeros((1, 3))])[bodies]
        inertia = inverse_inertia[:, *np.triu_indices(3)]
        ease = np.concatenate([inverse_mass[:, None], inertia], axis=1)
        return cls(axes, bodies, movers, arms, ease, _islands(movers, n))

    @property
    def body_count(self) -> int:
        """n."""
        return len(self.ease)

    def chosen(self, rows: Indices) -> ContactSystem:
        """The system of some of the contacts."""
        movers = self.movers[rows]
        islands = _islands(movers, self.body_count)
        return ContactSystem(self.axes[rows], self.bodies[rows], movers, self.arms[rows], self.ease, islands)

    def velocities(self, of_bodies: Array) -> Array:
        """Velocities at the contacts, (k, 3), of velocities (v, omega) of the moving bodies, (n, 6)."""
        both = np.concatenate([of_bodies, np.zeros((1, 6))])[self.bodies]
        at = both[..., :3] + cross(both[..., 3:], self.arms)
        return np.einsum("kci,ki->kc", self.axes, at[:, 0] - at[:, 1])

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


def solve_velocities(
    system: ContactSystem, free: Array, *, least_normal: Array, friction: Array, start: Array, tolerance: Array
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
    """
    bias = free.copy()
    bias[:, 0] -= least_normal
    return _sweep(system, bias, np.zeros(len(free)), friction, _admissible(start, friction), tolerance)


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
    return _sweep(system, bias, np.where(two_sided, -LARGEST_IMPULSE, 0.0), np.zeros(k), np.zeros((k, 3)), tolerance)


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
    system: ContactSystem, bias: Array, lowest: Array, friction: Array, impulses: Array, tolerance: Array
) -> Solution:
    """Impulses from those given on, which are overwritten."""
    from sim.rigid.contact_kernels import COLUMNS, System, sweep_islands

    k = len(bias)
    order = np.argsort(system.islands, kind="stable").astype(np.int32)
    first = np.concatenate([[0], np.cumsum(np.bincount(system.islands))]).astype(np.int32)
    islands = len(first) - 1
    change, sweeps = np.zeros((system.body_count, 6)), np.zeros(islands, dtype=np.int32)
    axes, arms = system.axes.reshape(k, 9), system.arms.reshape(k, 6)
    sweep_islands(
        order,
        first,
        System(system.movers, axes, arms, system.ease, bias, lowest, friction),
        tolerance,
        np.full(islands, MAX_ITERATIONS, dtype=np.int32),
        impulses,
        change,
        np.empty((k, COLUMNS)),
        sweeps,
    )
    most = int(sweeps.max())
    return Solution(impulses, change, min(most, MAX_ITERATIONS), most <= MAX_ITERATIONS)


def _islands(movers: NDArray[np.int32], n: int) -> Indices:
    """Numbers of the groups of contacts, (k,), that bodies which impulses move link."""
    linking = (movers >= 0).all(axis=1)
    first, second = movers[linking].T
    links = coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(n, n))
    group = connected_components(links, directed=False)[1]
    return np.unique(group[movers.max(axis=1)], return_inverse=True)[1].astype(np.int64)


def _admissible(impulses: Array, friction: Array) -> Array:
    """Impulses with the normal one not negative and the tangential ones within friction."""
    normal = np.maximum(impulses[:, 0], 0.0)
    size = np.sqrt(np.square(impulses[:, 1:]).sum(axis=1))
    limit = friction * normal
    share = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    return np.concatenate([normal[:, None], share[:, None] * impulses[:, 1:]], axis=1)
