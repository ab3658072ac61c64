"""How moving bodies answer to the fluid's forces within a step: strong coupling for implicit pressure."""

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.boundary import Boundary
from sim.fluid.boundary_kernels import NO_BODY, STATE_WIDTH, WRENCH_WIDTH
from sim.fluid.kernels import TINY_DISTANCE, spline, spline_slope
from sim.fluid.pressure_kernels import error_left
from sim.launch import fast_launch

MOBILITY_WIDTH = 10
"""Numbers of a body's mobility: inverse mass, then the inverse inertia tensor row by row, in world axes."""

LARGEST_SHARE = 2**30
"""Sums over particles are of 32-bit integers, which are exact in any order; one bit is the sign's, one is spare."""

PARTICLES_PER_SAMPLE = 8
"""More particles than this cannot be within the support of a sample for each of them: they lie in three layers."""

LARGEST_PUSH = 6.0
"""|sum_b V_b grad W_ib| of a particle that is pressed onto samples, over 1/d; it is 0.9 at rest beside them."""


class BodyResponse:
    """Accelerations of the bodies' samples by forces on the bodies.

    With the pressure solve's matrix of rates of change, D, the bodies are columns of their own: their velocities u
    change the density of particle i by -n_i . u, with the wrench n_i = sum_b V_b (grad W_ib, r_b x grad W_ib) that a
    unit of V P_i puts on the body. As the same n_i is in the force and in the rate, A = V D M^-1 D^T over particles and
    bodies stays symmetric and positive semi-definite, and the solve finds the pressure at which fluid and bodies move
    together. Explicit coupling diverges where the fluid that a body has to push aside is heavier than the body, and
    lets a light body start with g (rho_s - rho_f)/rho_s instead of g (rho_s - rho_f)/(rho_s + rho_f/2), a sphere's.

    Free bodies fall by gravity in their predicted velocity; contacts of the step are not foreseen.

    Attributes:
        is_needed: whether any body is free to answer.
        inverse_masses: M^-1 of each body, mass [1/kg] and inertia tensor in world axes [1/(kg m²)], (bodies, 6, 6), on
            the host; 0 for bodies on given paths.
        no_acceleration: of all boundary samples where none is [m/s²].
    """

    def __init__(self, boundary: Boundary, gravity: tuple[float, float, float], spacing: float) -> None:
        """Prepare for the bodies of a boundary; they do not answer before `set_mobility`.

        Args:
            boundary: holds the bodies' samples.
            gravity: [m/s²].
            spacing: of the particles [m].
        """
        self._boundary, self._gravity, self._spacing = boundary, ti.math.vec3(*gravity), spacing
        bodies = max(boundary.body_count, 1)
        self._mobility = ti.ndarray(ti.f32, bodies * MOBILITY_WIDTH)
        self._mobility.fill(0.0)
        self._no_wrench = ti.ndarray(ti.f32, bodies * WRENCH_WIDTH)
        self._no_wrench.fill(0.0)
        self._share = ti.ndarray(ti.i32, bodies)
        self._cap, self._share_scale = ti.ndarray(ti.f32, bodies), ti.ndarray(ti.f32, bodies)
        self._acceleration = ti.Vector.ndarray(3, ti.f32, max(boundary.count, 1))
        self._acceleration.fill(0.0)
        self.is_needed = False
        self.inverse_masses: NDArray[np.float64] = np.zeros((boundary.body_count, WRENCH_WIDTH, WRENCH_WIDTH))
        self.no_acceleration = ti.Vector.ndarray(3, ti.f32, max(boundary.count, 1))
        self.no_acceleration.fill(0.0)

    def set_mobility(self, inverse_mass: NDArray[np.float64], inverse_inertia: NDArray[np.float64]) -> None:
        """Say how easily the bodies move where they are now.

        Args:
            inverse_mass: [1/kg], (bodies,); 0 for bodies on given paths.
            inverse_inertia: in world axes [1/(kg m²)], (bodies, 3, 3).
        """
        rows = np.concatenate([inverse_mass[:, None], inverse_inertia.reshape(-1, 9)], axis=1)
        self.is_needed = bool((inverse_mass > 0.0).any())
        self.inverse_masses[:, :3, :3] = inverse_mass[:, None, None] * np.eye(3)
        self.inverse_masses[:, 3:, 3:] = inverse_inertia
        if not len(rows):
            return
        self._mobility.from_numpy(np.ascontiguousarray(rows, dtype=np.float32).ravel())
        turning = np.trace(inverse_inertia, axis1=1, axis2=2) * self._boundary.reach**2
        cap = LARGEST_PUSH / self._spacing * np.sqrt(inverse_mass + turning)
        particles = PARTICLES_PER_SAMPLE * (np.diff(self._boundary.body_start) + PARTICLES_PER_SAMPLE)
        scale = np.divide(LARGEST_SHARE, particles * cap, out=np.zeros_like(cap), where=cap > 0.0)
        self._cap.from_numpy(cap.astype(np.float32))
        self._share_scale.from_numpy(scale.astype(np.float32))

    def fall(self, dt: float) -> None:
        """Let gravity act on the samples' velocities for dt [s]."""
        self._push(self._no_wrench, dt, 1.0)

    def push_samples(self, wrench: ti.Ndarray, dt: float) -> None:
        """Let forces and torques on the bodies act on the samples' velocities for dt [s]."""
        self._push(wrench, dt, 0.0)

    def accelerate_samples(self, wrench: ti.Ndarray) -> ti.Ndarray:
        """Accelerations of all boundary samples by forces and torques on the bodies [m/s²]; 0 for the fixed ones."""
        boundary = self._boundary
        accelerate_samples(
            boundary.position, boundary.fixed_count, boundary.body_sample_count, boundary.body, boundary.states,
            wrench, self._mobility, self._acceleration,
        )  # fmt: skip
        return self._acceleration

    def add_to_diagonal(
        self, position: ti.Ndarray, count: int, neighbor_list: tuple[Any, ...], *,
        volume: float, gradient_factor: float, inverse_support: float, relaxation: float, inverse_diagonal: ti.Ndarray,
    ) -> None:  # fmt: skip
        """Add the bodies' share in A to its diagonal, such that relaxation by the diagonal converges.

        The bodies' part of A, B_ij = V n_i . M^-1 n_j, couples all particles around a body, so that its own diagonal
        says little: its largest eigenvalue over that of the fluid's part is about the mass of the layer of fluid around
        the body over the body's. But with |n|² = n . M^-1 n and Cauchy's inequality, x . B x <= V (sum |n_i| |x_i|)²
        <= V sum_j |n_j| sum_i |n_i| x_i²: the diagonal matrix of V |n_i| sum_j |n_j| bounds B.

        Args:
            position: of the particles [m].
            count: number of particles.
            neighbor_list: as the kernels take it.
            volume: V [m³].
            gradient_factor: sigma/h of the kernel [1/m⁴].
            inverse_support: 1/h [1/m].
            relaxation: omega that multiplies the inverse diagonal in the solve; the bound needs none.
            inverse_diagonal: 1/A_ii [kg/m]; becomes 1/(A_ii + omega times the bound). A particle that has 0 keeps it.
        """
        boundary = self._boundary
        add_bodies_to_diagonal(
            position, count, *neighbor_list, boundary.position, boundary.volume, boundary.fixed_count,
            boundary.body, boundary.body_count, boundary.states, self._mobility, self._cap, self._share_scale,
            gradient_factor, inverse_support, relaxation * volume, self._share, inverse_diagonal,
        )  # fmt: skip

    def _push(self, wrench: ti.Ndarray, dt: float, gravity_share: float) -> None:
        boundary = self._boundary
        push_samples(
            boundary.position, boundary.fixed_count, boundary.body_sample_count, boundary.body, boundary.states,
            wrench, self._mobility, gravity_share * self._gravity, dt, boundary.velocity,
        )  # fmt: skip


@ti.func
def acceleration_at(x_b: ti.math.vec3, body: ti.i32, states: Floats, wrench: Floats, mobility: Floats) -> ti.math.vec3:
    """Acceleration of a point of a body by a force and torque on the body; the centripetal part does not count."""
    s, w, m = body * STATE_WIDTH, body * WRENCH_WIDTH, body * MOBILITY_WIDTH
    force = ti.math.vec3(wrench[w], wrench[w + 1], wrench[w + 2])
    torque = ti.math.vec3(wrench[w + 3], wrench[w + 4], wrench[w + 5])
    arm = x_b - ti.math.vec3(states[s], states[s + 1], states[s + 2])
    return mobility[m] * force + times_inverse_inertia(m, mobility, torque).cross(arm)


@ti.func
def times_inverse_inertia(m: ti.i32, mobility: Floats, vector: ti.math.vec3) -> ti.math.vec3:
    """I^-1 times a vector, of the body whose mobility begins at m."""
    product = ti.math.vec3(0.0)
    for row in ti.static(range(3)):
        first = m + 1 + 3 * row
        product[row] = mobility[first] * vector[0] + mobility[first + 1] * vector[1] + mobility[first + 2] * vector[2]
    return product


@fast_launch
@ti.kernel
def push_samples(
    sample_position: Vectors, first: ti.i32, count: ti.i32, body: Integers, states: Floats, wrench: Floats,
    mobility: Floats, gravity: ti.math.vec3, dt: ti.f32, sample_velocity: Vectors,
):  # fmt: skip
    """v_b += dt (g + F/m + (I^-1 M) x r_b) for free bodies."""
    for b in range(count):
        a_b = acceleration_at(sample_position[first + b], body[b], states, wrench, mobility)
        if mobility[body[b] * MOBILITY_WIDTH] > 0.0:
            a_b += gravity
        sample_velocity[first + b] += dt * a_b


@fast_launch
@ti.kernel
def accelerate_samples(
    sample_position: Vectors, first: ti.i32, count: ti.i32, body: Integers, states: Floats, wrench: Floats,
    mobility: Floats, acceleration: Vectors,
):  # fmt: skip
    """a_b = F/m + (I^-1 M) x r_b."""
    for b in range(count):
        acceleration[first + b] = acceleration_at(sample_position[first + b], body[b], states, wrench, mobility)


@ti.func
def next_body(
    last: ti.i32, first: ti.i32, count: ti.i32, neighbors: Integers, stride: ti.template(), fixed_count: ti.i32,
    body: Integers,
) -> ti.i32:  # fmt: skip
    """Lowest number above `last` of the bodies with a sample among these neighbours, or a huge one."""
    found = NO_BODY
    for k in range(count):
        b = neighbors[first + k * stride]
        if b >= fixed_count:
            own = body[b - fixed_count]
            if own > last:
                found = ti.min(found, own)
    return found


@ti.func
def wrench_norm(
    x_i: ti.math.vec3, first: ti.i32, count: ti.i32, neighbors: Integers, stride: ti.template(),
    sample_position: Vectors, sample_volume: Floats, fixed_count: ti.i32, body: Integers, wanted: ti.i32,
    states: Floats, mobility: Floats, gradient_factor: ti.f32, inverse_support: ti.f32,
) -> ti.f32:  # fmt: skip
    """|n_i| = sqrt(n_i . M^-1 n_i) for the body `wanted`."""
    s, m = wanted * STATE_WIDTH, wanted * MOBILITY_WIDTH
    centre = ti.math.vec3(states[s], states[s + 1], states[s + 2])
    force = ti.math.vec3(0.0)
    torque = ti.math.vec3(0.0)
    for k in range(count):
        b = neighbors[first + k * stride]
        if b >= fixed_count and body[b - fixed_count] == wanted:
            x_ib = x_i - sample_position[b]
            r = x_ib.norm()
            f = sample_volume[b] * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ib
            force += f
            torque += (sample_position[b] - centre).cross(f)
    squared = mobility[m] * force.norm_sqr() + torque.dot(times_inverse_inertia(m, mobility, torque))
    return gradient_factor * ti.sqrt(ti.max(squared, 0.0))


@fast_launch
@ti.kernel
def add_bodies_to_diagonal(
    position: Vectors, particle_count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    sample_position: Vectors, sample_volume: Floats, fixed_count: ti.i32, body: Integers, body_count: ti.i32,
    states: Floats, mobility: Floats, cap: Floats, share_scale: Floats, gradient_factor: ti.f32,
    inverse_support: ti.f32, weight: ti.f32, share: Integers, inverse_diagonal: Floats,
):  # fmt: skip
    """1/A_ii becomes 1/(A_ii + weight sum over bodies of |n_i| sum_j |n_j|); the sums over j are of integers."""
    for k in range(body_count):
        share[k] = 0
    for i in range(particle_count):
        first = start[i] + fluid_count[i] * stride
        own = next_body(-1, first, boundary_count[i], neighbors, stride, fixed_count, body)
        while own < NO_BODY:
            norm = wrench_norm(
                position[i], first, boundary_count[i], neighbors, stride, sample_position, sample_volume, fixed_count,
                body, own, states, mobility, gradient_factor, inverse_support,
            )  # fmt: skip
            ti.atomic_add(share[own], ti.cast(ti.ceil(ti.min(norm, cap[own]) * share_scale[own]), ti.i32))
            own = next_body(own, first, boundary_count[i], neighbors, stride, fixed_count, body)
    for i in range(particle_count):
        first = start[i] + fluid_count[i] * stride
        own = next_body(-1, first, boundary_count[i], neighbors, stride, fixed_count, body)
        bound = 0.0
        while own < NO_BODY:
            norm = wrench_norm(
                position[i], first, boundary_count[i], neighbors, stride, sample_position, sample_volume, fixed_count,
                body, own, states, mobility, gradient_factor, inverse_support,
            )  # fmt: skip
            if share_scale[own] > 0.0:
                bound += norm * ti.cast(share[own], ti.f32) / share_scale[own]
            own = next_body(own, first, boundary_count[i], neighbors, stride, fixed_count, body)
        inverse = inverse_diagonal[i]
        inverse_diagonal[i] = inverse / (1.0 + weight * bound * inverse)


@fast_launch
@ti.kernel
def weigh_errors(
    sample_position: Vectors, sample_volume: Floats, first: ti.i32, sample_count: ti.i32,
    near_start: Integers, near_count: Integers, near: Integers, remaining: Floats, pressure: Floats,
    position: Vectors, inverse_diagonal: Floats, dt_squared: ti.f32, inverse_support: ti.f32, weighed: Vectors,
):  # fmt: skip
    """Errors of the particles near each sample as a pressure solve counts them, and their weights, V_b w_ib each."""
    for b in range(sample_count):
        total = ti.math.vec3(0.0)
        for k in range(near_start[b], near_start[b] + near_count[b]):
            i = near[k]
            if inverse_diagonal[i] > 0.0:
                weight = spline((position[i] - sample_position[first + b]).norm() * inverse_support)
                error = error_left(remaining[i], pressure[i], inverse_diagonal[i], dt_squared)
                total += weight * ti.math.vec3(error, 1.0, 0.0)
        weighed[b] = sample_volume[first + b] * total
