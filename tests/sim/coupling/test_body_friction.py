"""Implicit viscosity between a fluid and the bodies in it."""

import itertools

import numpy as np
import pytest
from coupled_tanks import OPEN_SPACE, WEIGHTLESS, Tank

from sim.core.domain import DomainParameters
from sim.fluid.kernels import evaluate_slope
from sim.fluid.viscosity import TOLERANCE

STICKY = {"wall_friction": 1.0, "artificial_viscosity": 0.0, "viscosity_solver": "implicit"}


def box(density: float, size: tuple[float, ...], **more: object) -> dict:
    return {"kind": "dynamic", "density": density, "shape": {"type": "box", "size": size}, **more}


@pytest.mark.parametrize(
    ("solver", "viscosity", "density", "dt"),
    [("dfsph", 1.0, 200.0, "adaptive"), ("pcisph", 0.1, 50.0, "adaptive"), ("wcsph", 1.0, 200.0, 5.0e-4)],
)
def test_a_light_box_in_honey_comes_to_rest_without_ringing(taichi_cpu, solver, viscosity, density, dt):
    domain = DomainParameters(min=(-0.1, -0.1, 0.0), max=(0.1, 0.1, 0.3))
    tank = Tank(
        [box(density, (0.08, 0.08, 0.08), position=(0.0, 0.0, 0.07), velocity=(0.3, 0.0, 0.0))],
        domain=domain,
        water=(domain.min, (0.1, 0.1, 0.12)),
        solver=solver,
        viscosity=viscosity,
        dt=dt,
        **STICKY,
    )
    bodies, velocities, times = tank.rigid.bodies, [], []
    while sum(times) < 0.06:
        times.append(tank.step())
        velocities.append(bodies.velocity[0].copy())
    jumps = np.linalg.norm(np.diff(velocities, axis=0)[5:], axis=1)
    # In creeping flow nothing accelerates a body by more than its buoyancy would if nothing held it back. Friction that
    # is explicit in the body's velocity throws it by metres per second in every step.
    assert (jumps < (1000.0 / density - 1.0) * 9.81 * np.array(times[6:])).all()
    # 0.3 m/s are gone within L²/nu, 6 ms at the lower viscosity; it rises at some centimetres per second.
    assert np.linalg.norm(velocities[-1]) < 0.1
    assert np.abs(bodies.angular_velocity).max() < 1.0
    assert tank.fluid.diagnostics()["viscosity_error"] <= TOLERANCE


@pytest.mark.parametrize("solver", ["dfsph", "wcsph"])
def test_a_box_that_spins_in_a_drop_of_honey_keeps_momentum_and_takes_the_honey_along(taichi_cpu, solver):
    spinning = box(100.0, (0.06, 0.08, 0.06), velocity=(0.5, 0.0, 0.0), angular_velocity=(2.0, 0.0, 6.0))
    tank = Tank(
        [spinning],
        domain=OPEN_SPACE,
        water=((-0.08,) * 3, (0.08,) * 3),
        water_velocity=(0.0, 0.3, 0.0),
        gravity=WEIGHTLESS,
        solver=solver,
        viscosity=1.0,
        **STICKY,
    )
    linear, angular = tank.momentum()
    tank.run(0.02)
    linear_after, angular_after = tank.momentum()
    # Pair forces are opposite and central to float32 rounding, 6e-8 of each of up to a hundred kicks.
    assert np.abs(linear_after - linear).max() < 1.0e-5 * np.linalg.norm(linear)
    assert np.abs(angular_after - angular).max() < 1.0e-5 * (np.linalg.norm(angular) + 0.08 * np.linalg.norm(linear))
    # One viscous time, L²/nu = 6 ms, is long over: the light box flies and turns as the drop does.
    total_mass = tank.fluid.diagnostics()["mass"] + tank.rigid.bodies.mass[0]
    assert np.linalg.norm(tank.rigid.bodies.velocity[0] - linear / total_mass) < 0.05 * 0.58
    assert np.linalg.norm(tank.rigid.bodies.angular_velocity[0]) < 1.0


def test_velocities_and_error_are_those_of_the_explicit_matrix(taichi_cpu):
    tank = Tank(
        [
            box(60.0, (0.06, 0.06, 0.06), position=(0.05, 0.07, 0.09), velocity=(0.3, -0.2, 0.5)),
            box(200.0, (0.04, 0.08, 0.04), position=(0.13, 0.07, 0.07), angular_velocity=(3.0, -4.0, 5.0)),
        ],
        domain=DomainParameters(min=(0.0, 0.0, 0.0), max=(0.18, 0.14, 0.3)),
        water=((0.0, 0.0, 0.0), (0.18, 0.14, 0.14)),
        solver="dfsph",
        viscosity=0.3,
        **STICKY,
    )
    fluid, dt = tank.fluid, 2.0e-3
    fluid.compute_density()
    n = fluid.particle_count
    velocity = np.random.default_rng(2).normal(0.0, 0.5, (fluid.particles.capacity, 3)).astype(np.float32)
    fluid.particles.velocity.from_numpy(velocity)
    masses, matrix, given = friction_system(tank, dt)
    fluid.forces.acceleration.fill(0.0)
    fluid.begin_frame(0.0)
    fluid.forces.add_implicit_viscosity(dt)
    state, solver = fluid.diagnostics(), fluid.forces.implicit_viscosity

    def mean_square(change: np.ndarray) -> float:
        return float(change @ masses @ change) / 1000.0

    of_particles, of_bodies = solver._iterate.change.to_numpy()[:n], solver.bodies._change
    change = np.concatenate([of_particles.ravel(), of_bodies.ravel()]).astype(np.float64)
    left = np.linalg.solve(masses, given - matrix @ change)
    starts = [*range(0, 3 * n, 3), 3 * n, 3 * n + 6, 3 * n + 12]
    asked = np.concatenate([np.linalg.solve(matrix[i:j, i:j], given[i:j]) for i, j in itertools.pairwise(starts)])
    error = np.sqrt(mean_square(left) / mean_square(asked))
    # The residual is a small difference of float32 sums of some sixty forces.
    assert state["viscosity_error"] == pytest.approx(error, rel=0.05)
    assert error < TOLERANCE
    assert state["not_converged"] == 0.0
    # No eigenvalue is below that of the masses alone, which bounds the error of the velocities by the residual.
    exact = np.linalg.solve(matrix, given)
    assert mean_square(change - exact) < mean_square(left)
    # What acts are the pair sums at the velocities found.
    impulses = np.concatenate(fluid.body_forces.take_impulses(), axis=1).ravel() / fluid.particle_volume
    found = np.concatenate([1000.0 * dt * fluid.forces.acceleration.to_numpy()[:n].ravel(), impulses])
    acts = given - (matrix - masses) @ change
    np.testing.assert_allclose(found, acts, atol=1.0e-5 * np.abs(acts).max())


def friction_system(tank: Tank, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses, matrix and right-hand side of all particles and of two bodies, over V, (3 n + 12, ...), in float64."""
    fluid, bodies = tank.fluid, tank.rigid.bodies
    n, support, volume = fluid.particle_count, fluid.discretization.support_radius, fluid.particle_volume
    boundary = fluid.boundary
    position = np.concatenate([fluid.particles.position.to_numpy()[:n], boundary.samples.position.to_numpy()])
    velocity = np.concatenate([fluid.particles.velocity.to_numpy()[:n], boundary.samples.velocity.to_numpy()])
    position, velocity = position.astype(np.float64), velocity.astype(np.float64)
    volumes = np.concatenate([np.full(n, volume), boundary.samples.volume.to_numpy().astype(np.float64)])
    density = fluid.particles.density.to_numpy()[:n].astype(np.float64)

    # Changes of the velocities of particles and samples by the unknowns: (3 of each, 3 n + 12).
    jacobian = np.zeros((len(position), 3, 3 * n + 12))
    jacobian[np.arange(n)[:, None], np.arange(3), 3 * np.arange(n)[:, None] + np.arange(3)] = 1.0
    masses = np.diag(np.full(3 * n + 12, 1000.0))
    for body in range(2):
        first = 3 * n + 6 * body
        start, stop = n + boundary.fixed_count + boundary.body_start[body : body + 2]
        jacobian[start:stop, :, first : first + 3] = np.eye(3)
        arms = position[start:stop] - bodies.position[body]
        for axis in range(3):
            jacobian[start:stop, :, first + 3 + axis] = np.cross(np.eye(3)[axis], arms)
        masses[first : first + 3, first : first + 3] = np.eye(3) / (bodies.inverse_mass[body] * volume)
        masses[first + 3 : first + 6, first + 3 : first + 6] = np.linalg.inv(bodies.inverse_inertia()[body]) / volume

    matrix, given = masses.copy(), np.zeros(len(masses))
    for i in range(n):
        others = i + 1 + np.flatnonzero(np.linalg.norm(position[i + 1 :] - position[i], axis=1) < support)
        apart = position[i] - position[others]
        r = np.linalg.norm(apart, axis=1)
        mean_density = np.where(others < n, 0.5 * (density[i] + density[np.minimum(others, n - 1)]), density[i])
        k = dt * 10.0 * 1000.0 * fluid.parameters.viscosity * volumes[others] * np.abs(evaluate_slope(r, support))
        root = np.sqrt(k / (mean_density * r * (r**2 + 0.01 * support**2)))
        rows = np.einsum("p,pa,pac->pc", root, apart, jacobian[i] - jacobian[others])
        columns = np.flatnonzero(np.abs(rows).sum(axis=0))
        rows = rows[:, columns]
        matrix[np.ix_(columns, columns)] += rows.T @ rows
        given[columns] -= rows.T @ (root * (apart * (velocity[i] - velocity[others])).sum(axis=1))
    return masses, matrix, given
