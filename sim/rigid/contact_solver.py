"""Contact impulses: projected Gauss-Seidel on the impulses of all contacts, started from those of the last step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.rotation import cross
from sim.rigid.contacts import Array, Contacts, tangent_basis

MAX_ITERATIONS = 100
MAX_FRICTION_STEPS = 12
FRICTION_ROUNDING = 1.0 + 1.0e-12  # of the square of the impulse over that of its limit, where Newton's steps end
RELATIVE_TOLERANCE = 1.0e-6  # of the largest contact velocity: what one sweep may still change when it is the last


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """The linear relation between impulses at contacts and velocities there.

    Contact i has three rows: the normal and two tangents. With the Jacobian J, mass matrix M and impulses λ the
    velocities at the contacts are w = A λ + b, A = J M⁻¹ Jᵀ, b = J v.
    """

    axes: Array  # normal and tangents, (k, 3, 3)
    jacobian: Array  # of the moving bodies' velocities (v, omega), (k, 3, n, 6)
    response: Array  # M⁻¹ Jᵀ, transposed, (k, 3, n, 6)
    matrix: Array  # A, (3 k, 3 k)

    @classmethod
    def build(cls, contacts: Contacts, position: Array, inverse_mass: Array, inverse_inertia: Array) -> ContactSystem:
        """The system of some contacts of n moving bodies, which come first in the numbering of bodies."""
        k, n = len(contacts), len(position)
        axes = np.concatenate([contacts.normal[:, None], tangent_basis(contacts.normal)], axis=1)
        jacobian = np.zeros((k, 3, n, 6))
        for body, sign in ((contacts.first, 1.0), (contacts.second, -1.0)):
            moving = np.flatnonzero(body < n)
            number = body[moving]
            arm = contacts.point[moving] - position[number]
            jacobian[moving, :, number, :3] = sign * axes[moving]
            jacobian[moving, :, number, 3:] = sign * cross(arm[:, None], axes[moving])
        response = np.empty_like(jacobian)
        response[..., :3] = jacobian[..., :3] * inverse_mass[:, None]
        response[..., 3:] = np.einsum("kcni,nij->kcnj", jacobian[..., 3:], inverse_inertia)
        # No BLAS here: the bits of its products may depend on the number of threads.
        matrix = np.einsum("ip,jp->ij", jacobian.reshape(3 * k, 6 * n), response.reshape(3 * k, 6 * n))
        return cls(axes, jacobian, response, matrix)

    def velocities(self, velocity: Array, angular_velocity: Array) -> Array:
        """Velocities at the contacts, (k, 3), of the moving bodies' velocities, (n, 3) each."""
        both = np.concatenate([velocity, angular_velocity], axis=1)
        return np.einsum("kcni,ni->kc", self.jacobian, both)

    def velocity_changes(self, impulses: Array) -> Array:
        """Changes of the velocities at the contacts, (k, 3), by impulses (k, 3) along the axes."""
        changes: Array = np.einsum("ij,j->i", self.matrix, impulses.reshape(-1))
        return changes.reshape(-1, 3)

    def body_velocities(self, impulses: Array) -> tuple[Array, Array]:
        """Changes of velocity and angular velocity, (n, 3) each, by impulses (k, 3) along the axes."""
        both = np.einsum("kc,kcni->ni", impulses, self.response)
        return both[:, :3], both[:, 3:]


@dataclass(frozen=True, eq=False)
class Solution:
    """Impulses and how they were found."""

    impulses: Array  # along the axes of the contacts [N s], (k, 3)
    iterations: int  # sweeps over all contacts
    converged: bool  # whether the last sweep changed less than the tolerance


def solve_velocities(
    system: ContactSystem, free: Array, *, least_normal: Array, friction: Array, start: Array, tolerance: float
) -> Solution:
    """Impulses with w_n >= least_normal, λ_n >= 0, complementary, and Coulomb friction |λ_t| <= mu λ_n.

    Sweeps over contacts; of each, first the normal impulse, then both tangential ones exactly for that normal one
    (nonsmooth Gauss-Seidel; Jean 1999, "The non-smooth contact dynamics method"): they stop the slip if friction is
    strong enough, else they are as large as it allows, and opposite to the slip that is left.

    Args:
        system: of the contacts.
        free: velocities at the contacts without their impulses [m/s], (k, 3).
        least_normal: lower bound of the normal velocities [m/s], (k,).
        friction: coefficients mu [-], (k,).
        start: impulses to start from [N s], (k, 3).
        tolerance: largest change of a contact velocity in the last sweep [m/s].
    """
    k = len(free)
    bias = free.copy()
    bias[:, 0] -= least_normal
    rows = [np.ascontiguousarray(system.matrix[3 * i : 3 * i + 3]) for i in range(k)]
    own = system.matrix.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)]
    blocks = own[:, *np.triu_indices(3)].tolist()  # nn, n1, n2, 11, 12, 22
    biases, coefficients = bias.tolist(), friction.tolist()
    impulses = _admissible(start, friction)
    flat = impulses.reshape(-1)
    for iteration in range(1, MAX_ITERATIONS + 1):
        largest_change = 0.0
        for i in range(k):
            a_nn, a_n1, a_n2, a_11, a_12, a_22 = blocks[i]
            w_n, w_1, w_2 = rows[i].dot(flat).tolist()
            b_n, b_1, b_2 = biases[i]
            at = 3 * i
            old_n, old_1, old_2 = flat[at : at + 3].tolist()
            new_n = max(old_n - (w_n + b_n) / a_nn, 0.0)
            if new_n == 0.0 == old_n:
                continue
            change_n = new_n - old_n
            # Slip without the tangential impulses of this contact.
            c_1 = w_1 + b_1 + a_n1 * change_n - a_11 * old_1 - a_12 * old_2
            c_2 = w_2 + b_2 + a_n2 * change_n - a_12 * old_1 - a_22 * old_2
            new_1, new_2 = _friction(a_11, a_12, a_22, c_1, c_2, coefficients[i] * new_n)
            flat[at], flat[at + 1], flat[at + 2] = new_n, new_1, new_2
            largest_change = max(
                largest_change, a_nn * abs(change_n), a_11 * abs(new_1 - old_1), a_22 * abs(new_2 - old_2)
            )
        if largest_change <= tolerance:
            return Solution(impulses, iteration, True)
    return Solution(impulses, MAX_ITERATIONS, False)


def solve_positions(
    system: ContactSystem, wanted: Array, *, two_sided: NDArray[np.bool_], tolerance: float
) -> Solution:
    """Normal impulses of a motion that moves bodies apart and leaves their velocities alone.

    Args:
        system: of the contacts.
        wanted: normal velocities of that motion [m/s], (k,): at least so much, or just so much.
        two_sided: contacts that get just that, (k,).
        tolerance: largest change of a contact velocity in the last sweep [m/s].
    """
    k = len(wanted)
    matrix = np.ascontiguousarray(system.matrix[::3, ::3])
    diagonal, targets = np.diagonal(matrix).tolist(), wanted.tolist()
    lowest = np.where(two_sided, -np.inf, 0.0).tolist()
    impulses = np.zeros((k, 3))
    normal = np.zeros(k)
    for iteration in range(1, MAX_ITERATIONS + 1):
        largest_change = 0.0
        for i in range(k):
            old = float(normal[i])
            new = max(old + (targets[i] - float(matrix[i].dot(normal))) / diagonal[i], lowest[i])
            normal[i] = new
            largest_change = max(largest_change, diagonal[i] * abs(new - old))
        impulses[:, 0] = normal
        if largest_change <= tolerance:
            return Solution(impulses, iteration, True)
    return Solution(impulses, MAX_ITERATIONS, False)


def _friction(a_11: float, a_12: float, a_22: float, c_1: float, c_2: float, limit: float) -> tuple[float, float]:
    """Tangential impulses x with slip w = A x + c: w = 0, or |x| = limit and w = -κ x with κ > 0.

    The second solves (A + κ) x = -c; Newton's method on 1/limit = 1/|x(κ)|, which is nearly linear in κ, approaches
    its root from below (Conn, Gould & Toint 2000, "Trust-region methods", 7.3).
    """
    if limit <= 0.0:
        return 0.0, 0.0
    kappa = 0.0
    for _ in range(MAX_FRICTION_STEPS):
        d_11, d_22 = a_11 + kappa, a_22 + kappa
        determinant = d_11 * d_22 - a_12 * a_12
        x_1, x_2 = (a_12 * c_2 - d_22 * c_1) / determinant, (a_12 * c_1 - d_11 * c_2) / determinant
        square = x_1 * x_1 + x_2 * x_2
        if square <= limit * limit * FRICTION_ROUNDING:
            return x_1, x_2
        # -x·dx/dκ = x·(A + κ)⁻¹x
        fall = (d_22 * x_1 * x_1 - 2.0 * a_12 * x_1 * x_2 + d_11 * x_2 * x_2) / determinant
        kappa += (square**0.5 / limit - 1.0) * square / fall
    scale = limit / square**0.5
    return scale * x_1, scale * x_2


def _admissible(impulses: Array, friction: Array) -> Array:
    """Impulses with the normal one not negative and the tangential ones within friction."""
    normal = np.maximum(impulses[:, 0], 0.0)
    size = np.sqrt(np.square(impulses[:, 1:]).sum(axis=1))
    limit = friction * normal
    share = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    return np.concatenate([normal[:, None], share[:, None] * impulses[:, 1:]], axis=1)
