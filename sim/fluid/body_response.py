"""Answer of moving bodies to the fluid's forces within a step: strong coupling for implicit pressure."""

from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.host_access import put
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.reductions import is_finite
from sim.fluid.boundary import NO_BODY, STATE_WIDTH, WRENCH_WIDTH, Bodies, Boundary, NearParticles, Samples
from sim.fluid.kernels import TINY_DISTANCE, Discretization, spline, spline_slope
from sim.fluid.particles import Fluid

MOBILITY_WIDTH = 10  # numbers of a body: inverse mass, then the inverse inertia tensor row by row, in world axes
LARGEST_SHARE = 2**30  # of sums of int32, which are exact in any order; one bit is the sign's, one is spare
PARTICLES_PER_SAMPLE = 8  # most that are within the support of a sample for each of them: they lie in three layers
LARGEST_PUSH = 6.0  # |sum_b V_b grad W_ib| of a particle pressed onto samples, over 1/d; 0.9 at rest beside them
NOT_FINITE = 1.0e30  # stands for an error that is infinite or not a number, which the larger of two numbers would hide


@bundle
class Mobility(NamedTuple):
    """Inverse masses of the bodies, and their bounds on the pressure matrix, (bodies,) each."""

    inverse_mass: Floats  # inverse mass [1/kg] and inertia tensor [1/(kg m²)], 10 numbers a body
    cap: Floats  # largest |n_i| of a particle that counts
    share_scale: Floats  # units of the integer sums over 1 of |n_j|
    share: Integers  # sum of |n_j| in these units


@bundle
class SolveError(NamedTuple):
    """Result of a pressure solve, (capacity,) each."""

    remaining: Floats  # compression that is left of each particle [-]
    pressure: Floats  # with which it is left, P [Pa]
    inverse_diagonal: Floats  # 1/A_ii [kg/m]
    dt_squared: ti.f32  # of the step [s²]; 0 for what is left where no pressure has acted yet


class BodyResponse:
    """Accelerations of the bodies' samples by forces on the bodies.

    With the pressure solve's matrix of rates of change, D, the bodies are columns of their own: their velocities u
    change the density of particle i by -n_i . u, with the wrench n_i = sum_b V_b (grad W_ib, r_b x grad W_ib) that a
    unit of V P_i puts on the body. As the same n_i is in the force and in the rate, A = V D M^-1 D^T over particles and
    bodies stays symmetric and positive semi-definite, and the solve finds the pressure at which fluid and bodies move
    together. Explicit coupling diverges where the fluid that a body has to push aside is heavier than the body.

    Free bodies fall by gravity in their predicted velocity; contacts of the step are not foreseen.

    Attributes:
        is_needed: whether any body is free to answer.
        inverse_masses: M^-1 of each body, mass [1/kg] and inertia tensor in world axes [1/(kg m²)], (bodies, 6, 6), on
            the host; 0 for bodies on given paths.
        acceleration, no_acceleration: of all boundary samples [m/s²], the latter 0 for all; the former is 0 for the
            fixed ones.
    """

    def __init__(self, boundary: Boundary, gravity: Vector3, discretization: Discretization) -> None:
        """Prepare for the bodies of a boundary; they do not answer before `set_mobility`."""
        self._boundary, self._gravity, self._discretization = boundary, ti.math.vec3(*gravity), discretization
        bodies = max(boundary.body_count, 1)
        self._mobility = Mobility(
            inverse_mass=on_device(np.zeros(bodies * MOBILITY_WIDTH)),
            cap=ti.ndarray(ti.f32, bodies),
            share_scale=ti.ndarray(ti.f32, bodies),
            share=ti.ndarray(ti.i32, bodies),
        )
        self._no_wrench = on_device(np.zeros(bodies * WRENCH_WIDTH))
        self.acceleration, self.no_acceleration = (on_device(np.zeros((boundary.count, 3))) for _ in range(2))
        self.is_needed = False
        self.inverse_masses: NDArray[np.float64] = np.zeros((boundary.body_count, WRENCH_WIDTH, WRENCH_WIDTH))

    def set_mobility(self, inverse_mass: NDArray[np.float64], inverse_inertia: NDArray[np.float64]) -> None:
        """Take inverse masses [1/kg], (bodies,), 0 on given paths, and tensors in world axes, (bodies, 3, 3).

        Emitters' pistons, which are the last of the boundary's bodies, are on given paths and may be left out.
        """
        pistons = self._boundary.body_count - len(inverse_mass)
        inverse_mass = np.pad(inverse_mass, (0, pistons))
        inverse_inertia = np.pad(inverse_inertia, ((0, pistons), (0, 0), (0, 0)))
        rows = np.concatenate([inverse_mass[:, None], inverse_inertia.reshape(-1, 9)], axis=1)
        self.is_needed = bool((inverse_mass > 0.0).any())
        self.inverse_masses[:, :3, :3] = inverse_mass[:, None, None] * np.eye(3)
        self.inverse_masses[:, 3:, 3:] = inverse_inertia
        if not len(rows):
            return
        put(self._mobility.inverse_mass, rows.ravel())
        turning = np.trace(inverse_inertia, axis1=1, axis2=2) * self._boundary.reach**2
        cap = LARGEST_PUSH / self._discretization.spacing * np.sqrt(inverse_mass + turning)
        particles = PARTICLES_PER_SAMPLE * (self._boundary.sample_counts() + PARTICLES_PER_SAMPLE)
        scale = np.divide(LARGEST_SHARE, particles * cap, out=np.zeros_like(cap), where=cap > 0.0)
        put(self._mobility.cap, cap)
        put(self._mobility.share_scale, scale)

    @property
    def mobility(self) -> ti.Ndarray:
        """Inverse mass [1/kg] and inertia tensor [1/(kg m²)], 10 numbers a body, on the device."""
        return self._mobility.inverse_mass

    def fall(self, dt: float) -> None:
        """Let gravity act on the samples' velocities for dt [s]."""
        samples, bodies = self._boundary.samples, self._boundary.bodies
        push_samples(samples, bodies, self._no_wrench, self.mobility, self._gravity, dt)

    def add_to_diagonal(self, fluid: Fluid, relaxation: float, inverse_diagonal: ti.Ndarray) -> None:
        """Add the bodies' share in A to its diagonal, such that relaxation by the diagonal converges.

        The bodies' part of A, B_ij = V n_i . M^-1 n_j, couples all particles around a body, so that its own diagonal
        says little: its largest eigenvalue over that of the fluid's part is about the mass of the layer of fluid around
        the body over the body's. But with |n|² = n . M^-1 n and Cauchy's inequality, x . B x <= V (sum |n_i| |x_i|)²
        <= V sum_j |n_j| sum_i |n_i| x_i²: the diagonal matrix of V |n_i| sum_j |n_j| bounds B.

        1/A_ii becomes 1/(A_ii + omega times the bound), as the bound needs no relaxation omega; 0 stays 0.
        """
        d = self._discretization
        weight = relaxation * d.particle_volume
        add_bodies_to_diagonal(
            fluid, self._boundary.bodies, self._mobility, d.gradient_factor, weight, inverse_diagonal
        )


@func
def error_left(error: SolveError, i: ti.i32) -> ti.f32:
    """|compression left|; where that is negative, no more of it than taking P_i away would change."""
    left, pressure = error.remaining[i], error.pressure[i]
    most = ti.abs(ti.max(left, -pressure * error.dt_squared / error.inverse_diagonal[i]))
    return ti.select(is_finite(left) & is_finite(pressure), most, NOT_FINITE)


@func
def acceleration_at(x_b: ti.math.vec3, body: ti.i32, states: Floats, wrench: Floats, mobility: Floats) -> ti.math.vec3:
    """Acceleration of a point of a body by a force and torque on the body; the centripetal part does not count."""
    s, w, m = body * STATE_WIDTH, body * WRENCH_WIDTH, body * MOBILITY_WIDTH
    force = ti.math.vec3(wrench[w], wrench[w + 1], wrench[w + 2])
    torque = ti.math.vec3(wrench[w + 3], wrench[w + 4], wrench[w + 5])
    arm = x_b - ti.math.vec3(states[s], states[s + 1], states[s + 2])
    return mobility[m] * force + times_inverse_inertia(m, mobility, torque).cross(arm)


@func
def times_inverse_inertia(m: ti.i32, mobility: Floats, vector: ti.math.vec3) -> ti.math.vec3:
    """I^-1 times a vector, of the body whose mobility begins at m."""
    product = ti.math.vec3(0.0)
    for row in ti.static(range(3)):
        first = m + 1 + 3 * row
        product[row] = mobility[first] * vector[0] + mobility[first + 1] * vector[1] + mobility[first + 2] * vector[2]
    return product


@func
def push(samples: Samples, bodies: Bodies, wrench: Floats, mobility: Floats, gravity: ti.math.vec3, dt: ti.f32):
    """v_b += dt (g + F/m + (I^-1 M) x r_b) for free bodies."""
    for b in range(bodies.sample_count):
        a_b = acceleration_at(samples.position[bodies.first + b], bodies.body[b], bodies.states, wrench, mobility)
        if mobility[bodies.body[b] * MOBILITY_WIDTH] > 0.0:
            a_b += gravity
        samples.velocity[bodies.first + b] += dt * a_b


@kernel
def push_samples(samples: Samples, bodies: Bodies, wrench: Floats, mobility: Floats, gravity: ti.math.vec3, dt: ti.f32):
    """As `push`."""
    push(samples, bodies, wrench, mobility, gravity, dt)


@func
def accelerate(samples: Samples, bodies: Bodies, wrench: Floats, mobility: Floats, acceleration: Vectors):
    """a_b = F/m + (I^-1 M) x r_b."""
    for b in range(bodies.sample_count):
        acceleration[bodies.first + b] = acceleration_at(
            samples.position[bodies.first + b], bodies.body[b], bodies.states, wrench, mobility
        )


@func
def next_body(fluid: Fluid, bodies: Bodies, first: ti.i32, count: ti.i32, last: ti.i32) -> ti.i32:
    """Lowest number above `last` of the bodies with a sample among these neighbours, or `NO_BODY`."""
    found = NO_BODY
    for k in range(count):
        b = fluid.near.indices[first + k * fluid.near.stride]
        if b >= bodies.first:
            own = bodies.body[b - bodies.first]
            if own > last:
                found = ti.min(found, own)
    return found


@func
def wrench_norm(
    fluid: Fluid,
    bodies: Bodies,
    mobility: Floats,
    x_i: ti.math.vec3,
    first: ti.i32,
    count: ti.i32,
    body: ti.i32,
    gradient_factor: ti.f32,
) -> ti.f32:
    """|n_i| = sqrt(n_i . M^-1 n_i) for a body."""
    s, m = body * STATE_WIDTH, body * MOBILITY_WIDTH
    centre = ti.math.vec3(bodies.states[s], bodies.states[s + 1], bodies.states[s + 2])
    force = ti.math.vec3(0.0)
    torque = ti.math.vec3(0.0)
    for k in range(count):
        b = fluid.near.indices[first + k * fluid.near.stride]
        if b >= bodies.first and bodies.body[b - bodies.first] == body:
            x_ib = x_i - fluid.samples.position[b]
            r = x_ib.norm()
            f = fluid.samples.volume[b] * spline_slope(r * fluid.inverse_support) / (r + TINY_DISTANCE) * x_ib
            force += f
            torque += (fluid.samples.position[b] - centre).cross(f)
    squared = mobility[m] * force.norm_sqr() + torque.dot(times_inverse_inertia(m, mobility, torque))
    return gradient_factor * ti.sqrt(ti.max(squared, 0.0))


@kernel
def add_bodies_to_diagonal(
    fluid: Fluid, bodies: Bodies, mobility: Mobility, gradient_factor: ti.f32, weight: ti.f32, inverse_diagonal: Floats
):
    """1/A_ii becomes 1/(A_ii + weight sum over bodies of |n_i| sum_j |n_j|); the sums over j are of integers."""
    for k in range(bodies.count):
        mobility.share[k] = 0
    for i in range(fluid.particles.count):
        x_i, count = fluid.particles.position[i], fluid.near.boundary_count[i]
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        body = next_body(fluid, bodies, first, count, -1)
        while body < NO_BODY:
            norm = wrench_norm(fluid, bodies, mobility.inverse_mass, x_i, first, count, body, gradient_factor)
            units = ti.ceil(ti.min(norm, mobility.cap[body]) * mobility.share_scale[body])
            ti.atomic_add(mobility.share[body], ti.cast(units, ti.i32))
            body = next_body(fluid, bodies, first, count, body)
    for i in range(fluid.particles.count):
        x_i, count = fluid.particles.position[i], fluid.near.boundary_count[i]
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        body = next_body(fluid, bodies, first, count, -1)
        bound = 0.0
        while body < NO_BODY:
            norm = wrench_norm(fluid, bodies, mobility.inverse_mass, x_i, first, count, body, gradient_factor)
            if mobility.share_scale[body] > 0.0:
                bound += norm * ti.cast(mobility.share[body], ti.f32) / mobility.share_scale[body]
            body = next_body(fluid, bodies, first, count, body)
        inverse = inverse_diagonal[i]
        inverse_diagonal[i] = inverse / (1.0 + weight * bound * inverse)


@func
def weigh_errors(near: NearParticles, fluid: Fluid, error: SolveError, weighed: Vectors):
    """Errors of the particles near each sample as a pressure solve counts them, and their weights, V_b w_ib each."""
    for b in range(near.sample_count):
        total = ti.math.vec3(0.0)
        for k in range(near.start[b], near.start[b] + near.count[b]):
            i = near.particles[k]
            if error.inverse_diagonal[i] > 0.0:
                x_ib = fluid.particles.position[i] - fluid.samples.position[near.first + b]
                weight = spline(x_ib.norm() * fluid.inverse_support)
                total += weight * ti.math.vec3(error_left(error, i), 1.0, 0.0)
        weighed[b] = fluid.samples.volume[near.first + b] * total
