"""How bodies answer within a pressure solve."""

import numpy as np
from coupled_tanks import SPACING, Tank
from scipy.spatial.distance import cdist

from sim.core.domain import DomainParameters
from sim.fluid.kernels import evaluate_slope


def two_light_bodies() -> Tank:
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(14 * SPACING, 10 * SPACING, 14 * SPACING))
    ball = {"kind": "dynamic", "density": 100.0, "shape": {"type": "sphere", "radius": 2.5 * SPACING}}
    stick = {"kind": "dynamic", "density": 50.0, "shape": {"type": "box", "size": (2 * SPACING, 6 * SPACING, 0.05)}}
    return Tank(
        [
            {**ball, "position": (4 * SPACING, 5 * SPACING, 5 * SPACING)},
            {**stick, "position": (9.2 * SPACING, 5 * SPACING, 5 * SPACING), "rotation_deg": (10.0, 20.0, 0.0)},
        ],
        domain=domain,
        water=(domain.min, (domain.max[0], domain.max[1], 10 * SPACING)),
        solver="dfsph",
    )


def wrenches(tank: Tank) -> tuple[np.ndarray, np.ndarray]:
    """n_i of every particle and body in float64, (bodies, particles, 6), and the bodies' M^-1, (bodies, 6, 6)."""
    fluid, bodies = tank.fluid, tank.rigid.bodies
    x = fluid.particles.position.to_numpy()[: fluid.particle_count].astype(np.float64)
    first = fluid.boundary.fixed_count
    samples = fluid.boundary.samples.position.to_numpy()[first:].astype(np.float64)
    volumes = fluid.boundary.samples.volume.to_numpy()[first:].astype(np.float64)
    distance = cdist(x, samples)
    slope = np.where(
        distance < fluid.discretization.support_radius,
        evaluate_slope(distance, fluid.discretization.support_radius),
        0.0,
    )
    gradient = (volumes * slope / distance)[:, :, None] * (x[:, None] - samples[None])
    n, mobility = [], []
    for body, (start, stop) in enumerate(
        zip(fluid.boundary.body_start[:-1], fluid.boundary.body_start[1:], strict=True)
    ):
        own = gradient[:, start:stop]
        arm = samples[start:stop] - bodies.position[body]
        n.append(np.concatenate([own.sum(axis=1), np.cross(arm[None], own).sum(axis=1)], axis=1))
        mobility.append(np.zeros((6, 6)))
        mobility[-1][:3, :3] = bodies.inverse_mass[body] * np.eye(3)
        mobility[-1][3:, 3:] = bodies.inverse_inertia()[body]
    return np.array(n), np.array(mobility)


def test_the_diagonal_bounds_what_bodies_add_to_the_pressure_matrix(taichi_cpu):
    tank = two_light_bodies()
    fluid = tank.fluid
    fluid.compute_density()
    with_bodies = fluid.system.inverse_diagonal.to_numpy()[: fluid.particle_count].astype(np.float64)
    response, fluid.body_forces.response = fluid.body_forces.response, None
    fluid.compute_density()
    without = fluid.system.inverse_diagonal.to_numpy()[: fluid.particle_count].astype(np.float64)
    fluid.body_forces.response = response
    bound = (1.0 / with_bodies - 1.0 / without) / fluid.relaxation
    n, mobility = wrenches(tank)
    matrix = fluid.particle_volume * np.einsum("bia,bac,bjc->ij", n, mobility, n)
    eigenvalues = np.linalg.eigvalsh(np.diag(bound) - matrix)
    # float32 differences of diagonals leave a millionth of the largest.
    assert eigenvalues.min() > -1.0e-5 * bound.max()
    # The bound is not lavish either: within six, the rank of a body's part, of the largest eigenvalue.
    assert np.linalg.eigvalsh(matrix).max() > bound.max() / 12.0


def test_samples_answer_to_a_pressure_as_the_bodies_would(taichi_cpu):
    tank = two_light_bodies()
    fluid, bodies = tank.fluid, tank.rigid.bodies
    fluid.compute_density()
    pressure = np.random.default_rng(1).uniform(0.0, 1000.0, fluid.particles.capacity).astype(np.float32)
    fluid.next_pressure.from_numpy(pressure)
    fluid.accelerate_by(fluid.next_pressure)
    found = fluid.boundary_response.to_numpy()[: fluid.boundary.count]
    n, mobility = wrenches(tank)
    count = fluid.particle_count
    for body, (start, stop) in enumerate(
        zip(fluid.boundary.body_start[:-1], fluid.boundary.body_start[1:], strict=True)
    ):
        answer = mobility[body] @ (fluid.particle_volume * pressure[:count].astype(np.float64) @ n[body])
        first = fluid.boundary.fixed_count
        arm = fluid.boundary.samples.position.to_numpy()[first + start : first + stop] - bodies.position[body]
        expected = answer[:3] + np.cross(answer[3:], arm)
        # Sums of some hundred float32 forces of both signs.
        np.testing.assert_allclose(found[first + start : first + stop], expected, atol=1.0e-4 * np.abs(expected).max())
    np.testing.assert_array_equal(found[: fluid.boundary.fixed_count], 0.0)


def test_free_bodies_fall_within_the_step_and_driven_ones_do_not(taichi_cpu):
    tank = two_light_bodies()
    tank.rigid.bodies.is_dynamic[1] = False
    tank.coupling.resume()
    tank.fluid.body_forces.response.fall(0.5)
    boundary = tank.fluid.boundary
    velocity = boundary.samples.velocity.to_numpy()[: boundary.count]
    ball = slice(boundary.fixed_count, boundary.fixed_count + boundary.body_start[1])
    np.testing.assert_allclose(velocity[ball], np.broadcast_to([0.0, 0.0, -4.905], velocity[ball].shape), rtol=1.0e-6)
    np.testing.assert_array_equal(velocity[: boundary.fixed_count], 0.0)
    np.testing.assert_array_equal(velocity[boundary.fixed_count + boundary.body_start[1] :], 0.0)
