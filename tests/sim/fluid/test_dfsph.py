"""The pressure solves of divergence-free SPH against matrices that are written out."""

import numpy as np
import pytest
from small_fluids import EVERY_FACE, lattice, make_fluid

from sim.core.domain import DomainParameters
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
from sim.fluid.dfsph import NOT_SOLVED
from sim.fluid.kernels import evaluate, evaluate_slope

SPACING, SUPPORT = 0.02, 0.04
CORNER = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.2, 0.2, 0.2), open_faces=("x+", "y+", "z+"))


def pairs_of(points, others):
    """Vectors from all others to all points, (n, m, 3), and W and grad W there."""
    apart = points[:, None].astype(np.float64) - others[None].astype(np.float64)
    distance = np.linalg.norm(apart, axis=-1)
    slope = evaluate_slope(distance, SUPPORT)
    return evaluate(distance, SUPPORT), slope[..., None] * apart / np.maximum(distance, 1e-12)[..., None]


def explicit(position, walls, volume):
    """Relative densities, (n,), and the matrix D of their rates by the velocities of the particles, (n, n, 3)."""
    weights, gradients = pairs_of(position, position)
    samples = BoundarySamples.of_bodies(walls)
    wall_weights, wall_gradients = pairs_of(position, samples.positions)
    wall_volumes = samples.volumes(SPACING)
    density = volume * weights.sum(axis=1) + wall_weights @ wall_volumes
    rates = -volume * gradients
    own = volume * gradients.sum(axis=1) + np.einsum("nmk,m->nk", wall_gradients, wall_volumes)
    rates[np.arange(len(position)), np.arange(len(position))] += own
    return density, rates


@pytest.fixture
def shaken_corner(taichi_cpu):
    """Disordered fluid in a corner of walls, falling into it; density solves to 1e-7."""
    particles = lattice((0.0,) * 3, (0.1,) * 3, SPACING)
    random = np.random.default_rng(3)
    particles += random.uniform(-0.1 * SPACING, 0.1 * SPACING, particles.shape).astype(np.float32)
    velocities = random.normal(-0.5, 0.2, particles.shape).astype(np.float32)
    return make_fluid(
        CORNER,
        particles,
        velocities,
        solver="dfsph",
        dt=1.0e-3,
        artificial_viscosity=0.0,
        viscosity=0.0,
        density_tolerance=1e-7,
        divergence_tolerance=1e-7,
        max_iterations=2000,
    )


def test_density_and_diagonal_are_those_of_the_explicit_matrix(shaken_corner):
    fluid = shaken_corner
    fluid.compute_density()
    position = fluid.checkpoint()["position"]
    density, rates = explicit(position, domain_wall_samples(CORNER, SPACING), fluid.particle_volume)
    # A = V D M^-1 D^T with M = 1000 V, in float32.
    diagonal = (rates**2).sum(axis=(1, 2)) / 1000.0
    np.testing.assert_allclose(fluid.particles.host(fluid.particles.density), density, rtol=1e-5)
    np.testing.assert_allclose(fluid.particles.host(fluid.system.inverse_diagonal), 1.0 / diagonal, rtol=1e-4)


def test_a_step_leaves_no_compression_and_pushes_only_where_there_would_be(shaken_corner):
    fluid = shaken_corner
    before = fluid.checkpoint()["position"]
    density, rates = explicit(before, domain_wall_samples(CORNER, SPACING), fluid.particle_volume)
    correction = fluid.correction(1.0e-3)
    fluid.begin_frame(0.0)
    ids = fluid.checkpoint()["particle_id"]
    fluid.substep(1.0e-3)
    after = fluid.checkpoint()
    assert fluid.diagnostics()["not_converged"] == 0.0
    order = np.argsort(after["particle_id"])[np.argsort(np.argsort(ids))]
    velocity, pressure = after["velocity"][order].astype(np.float64), after["pressure"][order]
    left = 1.0e-3 * np.einsum("nmk,mk->n", rates, velocity) + np.minimum(density - 1.0, 0.0)
    # Of a compression that exists less is taken back at high pressure.
    taken_back = correction * fluid.firm_pressure / np.maximum(pressure, fluid.firm_pressure)
    left += taken_back * np.maximum(density - 1.0, 0.0)
    pushed = pressure > 0.01 * pressure.max()
    assert 20 < pushed.sum() < len(pressure)
    # The mean error is 1e-7, so that of one among 125 particles is at most 1.25e-5; float32 adds 1e-6.
    assert np.abs(left[pushed]).max() < 2e-5
    assert left.max() < 2e-5


def test_pressure_acts_as_the_transposed_matrix(shaken_corner):
    fluid = shaken_corner
    fluid.substep(1.0e-3)
    fluid.compute_density()
    position = fluid.checkpoint()["position"]
    _, rates = explicit(position, domain_wall_samples(CORNER, SPACING), fluid.particle_volume)
    pressure = fluid.particles.carried["pressure"]
    fluid.accelerate_by(pressure)
    expected = -np.einsum("nmk,n->mk", rates, fluid.particles.host(pressure).astype(np.float64)) / 1000.0
    # Sums of some thirty float32 terms that cancel in part.
    np.testing.assert_allclose(
        fluid.particles.host(fluid.pressure_acceleration), expected, atol=1e-5 * np.abs(expected).max(), rtol=1e-4
    )


def squeezed_cube(**tolerances: float):
    """A cube in free space with 6/s of compression everywhere."""
    domain = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)
    particles = lattice((-0.1,) * 3, (0.1,) * 3, SPACING)
    squeezed = (-2.0 * particles).astype(np.float32)
    return make_fluid(domain, particles, squeezed, gravity=(0.0,) * 3, solver="dfsph", dt=1.0e-3, **tolerances)


def test_divergence_is_gone_before_any_other_force_acts(taichi_cpu):
    fluid = squeezed_cube(divergence_tolerance=1e-7, max_iterations=1000)
    fluid.compute_density()
    fluid.correct_divergence_error(1.0e-3)
    state = fluid.checkpoint()
    _, gradients = pairs_of(state["position"], state["position"])
    velocity = state["velocity"].astype(np.float64)
    rate = fluid.particle_volume * np.einsum("nmk,nmk->n", velocity[:, None] - velocity[None], gradients)
    inside = (np.abs(state["position"]) < 0.1 - SPACING).all(axis=1)
    # 1e-7 in the mean of 1000 particles, in a step of 1 ms: at most 0.1/s of one particle, and it is far less in all.
    assert rate[inside].max() < 0.1
    # At the surface particles have room: they may close up.
    assert rate[~inside].max() > 1.0


def test_a_divergence_within_its_tolerance_is_relaxed_once_and_becomes_less(taichi_cpu):
    fluid = squeezed_cube(divergence_tolerance=0.1)
    fluid.begin_frame(0.0)
    fluid.compute_density()

    def mean_compression(velocity):
        apart = velocity[:, None].astype(np.float64) - velocity[None]
        rate = fluid.particle_volume * np.einsum("nmk,nmk->n", apart, gradients)
        return 1.0e-3 * np.maximum(rate[solved], 0.0).sum() / len(rate)

    before = fluid.checkpoint()
    _, gradients = pairs_of(before["position"], before["position"])
    solved = fluid.particles.host(fluid.particles.density) >= fluid.least_density
    fluid.correct_divergence_error(1.0e-3)
    state = fluid.diagnostics()
    assert state["divergence_iterations"] == 1.0
    # The error that is reported is that before the relaxation, in float32.
    assert state["divergence_error"] == pytest.approx(mean_compression(before["velocity"]), rel=1e-4)
    # 6/s inside for 1 ms, and one relaxation by a third of what its own pressure would take.
    assert 0.0 < mean_compression(fluid.checkpoint()["velocity"]) < 0.9 * state["divergence_error"]


@pytest.mark.parametrize("support", [2.0, 2.5, 3.0, 4.0])
def test_particles_at_walls_take_part_in_the_divergence_solve_and_those_at_the_surface_do_not(taichi_cpu, support):
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.2, 0.2, 0.3))
    particles = lattice((0.0,) * 3, (0.2, 0.2, 0.2), SPACING)
    fluid = make_fluid(domain, particles, solver="dfsph", support_in_spacings=support)
    fluid.compute_density()
    fluid.correct_divergence_error(1.0e-3)
    position = fluid.checkpoint()["position"]
    is_solved = fluid.particles.host(fluid.system.compression) > 0.5 * NOT_SOLVED
    is_at_surface = position[:, 2] > 0.2 - SPACING
    is_at_wall = (np.abs(position[:, :2] - 0.1) > 0.1 - SPACING).any(axis=1)
    assert is_solved[~is_at_surface].all()
    assert not is_solved[is_at_surface & ~is_at_wall].any()


def test_the_neighbour_list_has_no_skin_and_is_made_anew_for_every_step(shaken_corner):
    fluid = shaken_corner
    fluid.begin_frame(0.0)
    for _ in range(3):
        fluid.substep(1.0e-3)
    assert fluid.diagnostics()["neighbor_searches"] == 3.0  # one before the second step, the third and this
    position = fluid.checkpoint()["position"].astype(np.float64)
    near = np.linalg.norm(position[:, None] - position[None], axis=-1) < SUPPORT
    found = fluid.particles.neighbors.lists.fluid_count.to_numpy()[: fluid.particle_count]
    np.testing.assert_array_equal(found, near.sum(axis=1) - 1)
