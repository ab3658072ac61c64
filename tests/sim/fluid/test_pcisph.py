"""The predicted densities of predictive-corrective SPH."""

import numpy as np
import pytest
from small_fluids import EVERY_FACE, lattice, make_fluid

from sim.core.domain import DomainParameters

OPEN_SPACE = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)


def test_positions_after_a_step_have_the_density_that_was_predicted(taichi_cpu):
    particles = lattice((-0.1,) * 3, (0.1,) * 3, 0.02)
    fluid = make_fluid(
        OPEN_SPACE,
        particles,
        -2.0 * particles,
        gravity=(0.0,) * 3,
        solver="pcisph",
        dt=2.0e-3,
        density_tolerance=1e-6,
        max_iterations=1000,
    )
    fluid.substep(2.0e-3)
    assert fluid.diagnostics()["not_converged"] == 0.0
    # Compressed by 12 per mille without pressure; what 1e-6 in the mean leaves to one of 1000 particles is 1e-3.
    assert fluid.diagnostics()["max_compression"] < 1e-3
    inside = (np.abs(fluid.snapshots()["water"].arrays["position"]) < 0.05).all(axis=1)
    np.testing.assert_allclose(fluid.snapshots()["water"].arrays["density"][inside], 1000.0, rtol=1e-4)


def test_first_correction_is_that_of_a_filled_neighbourhood(taichi_cpu):
    # A lattice compressed by 1 %: delta (rho - 1) of its inner particles, with delta = 1/(lambda dt² A) by hand.
    particles = (lattice((-0.1,) * 3, (0.1,) * 3, 0.02) * 0.99 ** (1 / 3)).astype(np.float32)
    fluid = make_fluid(OPEN_SPACE, particles, gravity=(0.0,) * 3, solver="pcisph", dt=1.0e-3)
    fluid.compute_density()
    fluid.forces.acceleration.fill(0.0)
    fluid.pressure_acceleration.fill(0.0)
    pressure = fluid.particles.carried["pressure"]
    fluid.start_from(pressure)
    fluid.predict_and_correct(pressure, 1.0e-3, 0)
    inside = (np.abs(fluid.checkpoint()["position"]) < 0.06).all(axis=1)
    compression = fluid.particles.host(fluid.particles.density)[inside] - 1.0
    # sigma = 8/(pi h³), h = 2 d, V = d³: A = V² (sigma/h)² sum (6 (1-q)²)²/rho0 over 6, 12 and 8 neighbours.
    factor = 8.0 / (np.pi * 8.0) / 2.0 / 0.02
    squares = [count * (6.0 * (1.0 - r / 2.0) ** 2) ** 2 for count, r in ((6, 1.0), (12, 2**0.5), (8, 3**0.5))]
    delta = fluid.relaxation / (1.0e-6 * factor**2 * sum(squares) / 1000.0)
    # A compressed neighbourhood is stiffer by some percent than the lattice; the stiffer of the two counts.
    relaxed = fluid.particles.host(fluid.system.relaxed_before)[inside]
    correction = relaxed / (delta * compression * fluid.correction(1.0e-3))
    assert (correction > 0.9).all()
    assert (correction <= 1.001).all()


def flying_cube(**options: object):
    particles = lattice((-0.05,) * 3, (0.05,) * 3, 0.02)
    velocities = np.broadcast_to(np.float32((0.9, 0.0, 0.0)), particles.shape).copy()
    return make_fluid(OPEN_SPACE, particles, velocities, gravity=(0.0,) * 3, **options)


def test_neighbours_are_searched_before_a_step_can_go_beyond_their_list(taichi_cpu):
    searches = {}
    for solver in ("wcsph", "pcisph"):
        fluid = flying_cube(solver=solver, dt=0.5e-3)
        fluid.begin_frame(0.0)
        for _ in range(24):
            fluid.substep(0.5e-3)
        searches[solver] = fluid.diagnostics()["neighbor_searches"]
    # The skin is 4 mm, 2 mm for each of a pair, and a step goes 0.45 mm: five steps, and four if one looks one ahead.
    assert searches == {"wcsph": 4.0, "pcisph": 6.0}


def test_neighbours_are_searched_in_the_same_steps_after_a_resume(taichi_cpu):
    whole, resumed = (flying_cube(solver="pcisph", dt=2.5e-3) for _ in range(2))
    # A step goes 2.25 mm, more than the 2 mm that the skin allows each of a pair.
    whole.substep(2.5e-3)
    whole.diagnostics()
    resumed.restore(whole.checkpoint())
    searches = []
    for fluid in (whole, resumed):
        fluid.begin_frame(0.0)
        fluid.substep(2.5e-3)
        searches.append(fluid.diagnostics()["neighbor_searches"])
    assert searches == [2.0, 2.0]


def test_what_a_pair_adds_that_is_predicted_nearer_than_the_list_reaches_is_small(taichi_cpu):
    # Two rows head on at the speed that the step allows; they start a hair beyond the list, 2.2 d apart.
    left = lattice((-0.05, -0.05, -0.01), (0.05, 0.05, 0.01), 0.02)
    apart = np.float32((0.0, 0.0, 0.0441))
    particles = np.concatenate([left, left + apart])
    velocities = np.zeros_like(particles)
    velocities[:, 2] = np.where(particles[:, 2] > 0.02, np.float32(-1.0), np.float32(1.0))
    fluid = make_fluid(OPEN_SPACE, particles, velocities, gravity=(0.0,) * 3, solver="pcisph", artificial_viscosity=0.0)
    dt = fluid.stable_dt()
    assert dt == pytest.approx(0.2 * 0.02 / 1.0)
    fluid.compute_density()
    alone = fluid.particles.host(fluid.particles.density).max()
    fluid.substep(dt)
    nearest = 0.0441 - 2.0 * dt
    state = fluid.diagnostics()
    assert np.ptp(np.unique(fluid.snapshots()["water"].arrays["position"][:, 2].round(4))) == pytest.approx(nearest)
    # 6e-4 by the one straight ahead, and nothing by its neighbours, farther than 2 d by then.
    assert state["max_compression"] + 1.0 - alone < 6.5e-4
