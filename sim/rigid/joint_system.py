"""Rows of joints in a pose: how impulses and velocities go together, and what is asked of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim.rigid.contacts import Array, Indices
from sim.rigid.joint_order import Elimination

UNBOUNDED = 1.0e300  # [N s]: kernels know no infinity


@dataclass(frozen=True, eq=False)
class JointSystem:
    """The linear relation between impulses of joints and velocities there, as that of contacts."""

    elimination: Elimination
    is_there: NDArray[np.bool_]  # rows of joints that are not broken, whose bodies do not sleep, (r,)
    bodies: Indices  # numbers of the two bodies, (r, 2)
    movers: NDArray[np.int32]  # likewise, -1 where no impulse moves it
    jacobian: Array  # of the velocities (v, omega) of the two bodies, (r, 2, 6)
    response: Array  # M⁻¹ Jᵀ, (r, 2, 6)
    body_count: int  # all bodies, what stands and points among them

    @classmethod
    def build(
        cls,
        elimination: Elimination,
        is_there: NDArray[np.bool_],
        bodies: Indices,
        jacobian: Array,
        inverse_mass: Array,
        inverse_inertia: Array,
    ) -> JointSystem:
        """The system of bodies with inverse masses, (b,), and inertia, (b, 3, 3); 0 where impulses do not move them."""
        moves = (inverse_mass > 0.0)[bodies]
        response = np.empty_like(jacobian)
        response[..., :3] = jacobian[..., :3] * np.where(moves, inverse_mass[bodies], 0.0)[:, :, None]
        inertia = np.where(moves[:, :, None, None], inverse_inertia[bodies], 0.0)
        response[..., 3:] = np.einsum("rsij,rsj->rsi", inertia, jacobian[..., 3:])
        there = is_there & moves.any(axis=1)
        movers = np.where(moves, bodies, -1).astype(np.int32)
        return cls(elimination, there, bodies, movers, jacobian, response, len(inverse_mass))

    def velocities(self, of_bodies: Array) -> Array:
        """Velocities of the rows, (r,), of velocities (v, omega) of all bodies, (b, 6)."""
        return np.einsum("rsi,rsi->r", self.jacobian, of_bodies[self.bodies])

    def change(self, impulses: Array) -> Array:
        """What impulses, (r,), change of the velocities (v, omega) of all bodies, (b, 6)."""
        change = np.zeros((self.body_count, 6))
        np.add.at(change, self.bodies, self.response * impulses[:, None, None])
        return change

    def torques(self, impulses: Array) -> Array:
        """Angular impulses on all bodies [N m s], (b, 3), of impulses, (r,)."""
        sums = np.zeros((self.body_count + 1, 3))
        np.add.at(sums, self.movers, self.jacobian[..., 3:] * impulses[:, None, None])
        return sums[:-1]

    @cached_property
    def entries(self) -> Array:
        """The entries of A on and above the diagonal, (e,)."""
        entry, i, side_i, k, side_k = self.elimination.pairs.T
        terms = np.einsum("pj,pj->p", self.jacobian[i, side_i], self.response[k, side_k])
        return np.bincount(entry, weights=terms, minlength=len(self.elimination.entry_rows))

    def links(self) -> Indices:
        """The two bodies of rows that link what moves, (l, 2)."""
        linking = self.is_there & (self.movers >= 0).all(axis=1)
        result: Indices = self.movers[linking].astype(np.int64)
        return result


@dataclass(frozen=True, eq=False)
class JointDemand:
    """What is asked of the rows of joints: w = 0 with bounds lower <= λ <= upper, and w >= 0 or <= 0 at these.

    w = J v + softness λ + bias.
    """

    system: JointSystem
    is_there: NDArray[np.bool_]  # rows that take part, (r,)
    bias: Array  # the wanted velocities, negative, (r,)
    softness: Array  # (r,)
    lower: Array  # (r,), 0 at most
    upper: Array  # (r,), 0 at least

    def rows(self):  # type: ignore[no-untyped-def]
        """The rows as kernels take them, without impulses: a bundle of `joint_kernels.JointRows`."""
        from sim.rigid import joint_kernels as kernels

        order, r = self.system.elimination, len(self.bias)
        entries = self.system.entries
        own = entries[order.column[1:] - 1]
        whole = np.zeros((r + 1, kernels.WHOLE_COLUMNS), dtype=np.int32)
        whole[:-1, kernels.BODIES :][:, :2], whole[:-1, kernels.MOVES :][:, :2] = (
            self.system.bodies,
            self.system.movers >= 0,
        )
        whole[:-1, kernels.PARENT] = order.parent
        whole[:, kernels.COLUMN], whole[:, kernels.FACTOR] = order.column, order.factor
        state = np.where(self.lower >= 0.0, kernels.AT_LOWER, kernels.FREE)
        state = np.where(self.upper <= 0.0, kernels.AT_UPPER, state)
        whole[:-1, kernels.STATE] = np.where(self.is_there & (own > 0.0), state, kernels.OFF)
        numbers = np.zeros((r, kernels.NUMBER_COLUMNS))
        numbers[:, kernels.JACOBIAN :][:, :12] = self.system.jacobian.reshape(r, 12)
        numbers[:, kernels.RESPONSE :][:, :12] = self.system.response.reshape(r, 12)
        numbers[:, kernels.BIAS], numbers[:, kernels.SOFTNESS] = self.bias, self.softness
        numbers[:, kernels.LOWER], numbers[:, kernels.UPPER] = self.lower, self.upper
        numbers[:, kernels.OWN] = own
        components = np.zeros((len(order.components), kernels.COMPONENT_COLUMNS), dtype=np.int32)
        components[:, :2] = order.components
        filled = max(int(order.factor[-1]), 1)
        return kernels.JointRows(
            whole, numbers, order.entry_rows, entries, np.zeros(filled, dtype=np.int32), np.zeros(filled), components
        )


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Impulses of joints, and velocities with them."""

    impulses: Array  # (r,)
    velocity: Array  # (v, omega) of all bodies [m/s], [rad/s], (b, 6)
    converged: bool  # whether it was found in all components


def solve_alone(demand: JointDemand, velocity: Array) -> JointSolution:
    """Impulses of joints alone, of all bodies with velocities (v, omega) without them [m/s], [rad/s], (b, 6)."""
    from sim.rigid.joint_kernels import IMPULSE, solve_joints

    rows, velocity = demand.rows(), velocity.copy()
    is_settled = np.zeros(len(rows.components), dtype=np.int32)
    solve_joints(rows, velocity, is_settled)
    return JointSolution(rows.numbers[:, IMPULSE].copy(), velocity, bool(is_settled.all()))
