"""Free bodies as unknowns of implicit viscosity: the fluid holds on to them, however light they are."""

from collections.abc import Callable

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Vectors
from sim.core.host_access import put
from sim.core.launch import kernel
from sim.fluid.body_response import BodyResponse
from sim.fluid.boundary import STATE_WIDTH, WRENCH_WIDTH, Bodies, Boundary, Samples

Friction = Callable[[ti.Ndarray, ti.Ndarray], NDArray[np.float64]]
"""Forces and torques on the bodies [N], [N m], (bodies, 6), by the friction between particles and boundary samples of
these velocities; linear in both together."""


class BodyFriction:
    """The bodies' rows of the matrix of `sim.fluid.viscosity`, and their share of its solution.

    A change u = (dv, domega) of a body's velocities changes that of its sample b by J_b u = dv + domega x r_b. With the
    friction k_ib of the particles' rows, per volume V of a particle as there:

        M/V u + dt sum_ib J_b^T k_ib x_ib x_ib^T (J_b u - dv_i) = dt sum_ib J_b^T k_ib x_ib x_ib^T (v_i - v_b)

    The same k_ib is in both kinds of rows, so that the whole matrix stays symmetric and positive definite. Friction
    that is explicit in the body's velocity would throw a light body back and forth.

    Few numbers, in float64 on the host. Preconditioner: the 6 x 6 block of each body. Bodies on given paths are no
    unknowns; they have zeros.

    Attributes:
        changes: J_b u of each boundary sample for the vector that was spread last [m/s]; 0 for the fixed ones.
        preconditioned: u, the preconditioned residual, (bodies, 6).
    """

    def __init__(self, boundary: Boundary, response: BodyResponse | None, volume: float, rest_density: float) -> None:
        """Take the samples of the bodies, how they move, and the particles in whose number their mass counts."""
        self._boundary, self._response, self._volume, self._rest_density = boundary, response, volume, rest_density
        self._twists = ti.ndarray(ti.f32, max(boundary.body_count, 1) * WRENCH_WIDTH)
        self.changes = ti.Vector.ndarray(3, ti.f32, max(boundary.count, 1))
        self._found = ti.Vector.ndarray(3, ti.f32, max(boundary.count, 1))
        self.changes.fill(0.0)
        self._change = self._residual = self._product = np.zeros((boundary.body_count, WRENCH_WIDTH))
        self._direction = self._direction_product = self.preconditioned = self._given = self._change

    @property
    def are_free(self) -> bool:
        """Whether any body is an unknown; if not, only `forget` and `found_velocity` may be called."""
        return self._response is not None and self._response.is_needed

    def prepare(self, friction: Friction, velocity: ti.Ndarray, nothing: ti.Ndarray, dt: float) -> None:
        """Find the blocks of the matrix and the right-hand side of a step of dt [s].

        `velocity` is that of the particles, and `nothing` 0 for each of them [m/s].
        """
        assert self._response is not None
        self._friction, self._weight = friction, dt / self._volume
        self._inverse_mass = self._volume * self._response.inverse_masses
        is_free = self._inverse_mass[:, 0, 0] > 0.0
        self._free_weight = self._weight * is_free[:, None]
        self._mass = np.zeros_like(self._inverse_mass)
        self._mass[is_free] = np.linalg.inv(self._inverse_mass[is_free])
        blocks = self._mass.copy()
        for entry in range(WRENCH_WIDTH):
            self.spread(np.broadcast_to(np.eye(WRENCH_WIDTH)[entry], self._change.shape) * is_free[:, None])
            blocks[:, :, entry] -= self._weight * friction(nothing, self.changes)
        self._inverse = np.zeros_like(blocks)
        # Both halves are rounded sums of the same numbers.
        self._inverse[is_free] = np.linalg.inv(0.5 * (blocks + blocks.transpose(0, 2, 1))[is_free])
        self._given = self._free_weight * friction(velocity, self._boundary.samples.velocity)

    def guess(self, change: ti.Ndarray) -> None:
        """Begin with the change of the bodies at which their own rows hold, for this one of the particles [m/s]."""
        self.spread(np.zeros_like(self._change))
        self._change = _times(self._inverse, self._given + self._free_weight * self._friction(change, self.changes))
        self.spread(self._change)

    def forget(self) -> None:
        """Begin with no change."""
        self._change = np.zeros_like(self._change)
        self.spread(self._change)

    def restart(self, change: ti.Ndarray) -> None:
        """Find the residual for a change of the particles [m/s], and that of the bodies so far, which is spread."""
        self.spread(self._change)
        self._residual = self._given - self._multiplied(self._change, change)
        self.preconditioned = _times(self._inverse, self._residual)
        self._direction = self._direction_product = np.zeros_like(self._change)

    def norms(self) -> tuple[float, float, float]:
        """The bodies' part in what `sum_norms` sums, each with the weight of as many particles [m²/s²]."""
        asked = _times(self._inverse, self._given)
        asked_squared = _dot(asked, _times(self._mass, asked)) / self._rest_density
        return self._square(self._residual), self._square(self._given), asked_squared

    def multiply(self, preconditioned: ti.Ndarray) -> None:
        """The bodies' rows times u, which is spread, and this one of the particles [m/s]."""
        self._product = self._multiplied(self.preconditioned, preconditioned)

    def products(self) -> tuple[float, float, float]:
        """The bodies' part in what `sum_products` sums."""
        u = self.preconditioned
        return _dot(self._residual, u), _dot(self._product, u), self._square(self._residual)

    def advance(self, alpha: float, beta: float) -> None:
        """As `advance_solve` for the particles."""
        self._direction = self.preconditioned + beta * self._direction
        self._direction_product = self._product + beta * self._direction_product
        self._change = self._change + alpha * self._direction
        self._residual = self._residual - alpha * self._direction_product
        self.preconditioned = _times(self._inverse, self._residual)

    def found_velocity(self) -> ti.Ndarray:
        """Velocity of each boundary sample with the change found [m/s]."""
        if not self.are_free:
            return self._boundary.samples.velocity
        self.spread(self._change)
        add_vectors(self._boundary.samples.velocity, self.changes, self._boundary.count, self._found)
        return self._found

    def spread(self, twists: NDArray[np.float64]) -> None:
        """Fill `changes` with J_b u for the changes u of the bodies, (bodies, 6)."""
        if self._boundary.body_count == 0:
            return
        put(self._twists, twists.ravel())
        spread_twists(self._boundary.samples, self._boundary.bodies, self._twists, self.changes)

    def _multiplied(self, twists: NDArray[np.float64], vector: ti.Ndarray) -> NDArray[np.float64]:
        return _times(self._mass, twists) - self._free_weight * self._friction(vector, self.changes)

    def _square(self, rows: NDArray[np.float64]) -> float:
        """Square of the velocities that such an impulse would give the bodies, with the weight of their mass."""
        return _dot(rows, _times(self._inverse_mass, rows)) / self._rest_density


def _times(matrices: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.einsum("bij,bj->bi", matrices, rows)


def _dot(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float((one * other).sum())


@kernel
def spread_twists(samples: Samples, bodies: Bodies, twists: Floats, velocity: Vectors):
    """J_b u = dv + domega x r_b of each moving sample."""
    for b in range(bodies.sample_count):
        s, t = bodies.body[b] * STATE_WIDTH, bodies.body[b] * WRENCH_WIDTH
        centre = ti.math.vec3(bodies.states[s], bodies.states[s + 1], bodies.states[s + 2])
        arm = samples.position[bodies.first + b] - centre
        spin = ti.math.vec3(twists[t + 3], twists[t + 4], twists[t + 5])
        velocity[bodies.first + b] = ti.math.vec3(twists[t], twists[t + 1], twists[t + 2]) + spin.cross(arm)


@kernel
def add_vectors(one: Vectors, other: Vectors, count: ti.i32, total: Vectors):
    """total_i = one_i + other_i."""
    for i in range(count):
        total[i] = one[i] + other[i]
