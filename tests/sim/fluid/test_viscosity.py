"""Viscosity, explicit and implicit, against theory."""

import numpy as np
import pytest
from scipy.special import jv
from small_fluids import EVERY_FACE, lattice, make_fluid

from sim.core.domain import DomainParameters
from sim.fluid.parameters import FluidParameters, is_implicit
from sim.fluid.viscosity import TOLERANCE

OPEN_SPACE = DomainParameters(min=(-0.5, -0.5, -0.5), max=(0.5, 0.5, 0.5), open_faces=EVERY_FACE)
SPACING = 0.02
RADIUS = 0.2
WAVE_NUMBER = 5.135622 / RADIUS
"""J2(k R) = 0: the swirl v = J1(k r) has no shear stress at the free surface of a cylinder, and decays as a whole with
the rate nu k² (Navier-Stokes in cylindrical coordinates)."""


def swirling_cylinder(**parameters):
    """A free cylinder of 7 layers whose slow swirl is the slowest mode that is not a rotation, and that mode."""
    points = lattice((-0.3, -0.3, -0.07), (0.3, 0.3, 0.07), SPACING)
    points = points[np.hypot(points[:, 0], points[:, 1]) < RADIUS]
    radius = np.hypot(points[:, 0], points[:, 1])
    around = np.stack([-points[:, 1], points[:, 0], np.zeros(len(points))], axis=1) / radius[:, None]
    mode = (jv(1, WAVE_NUMBER * radius)[:, None] * around).astype(np.float32)
    # So slow that the particles do not move: 1e-4 m/s for less than a second.
    fluid = make_fluid(
        OPEN_SPACE, points, 1.0e-4 * mode, gravity=(0.0, 0.0, 0.0), artificial_viscosity=0.0, **parameters
    )
    return fluid, mode


def amplitude(fluid, mode) -> float:
    velocity = fluid.snapshots()["water"].arrays["velocity"].astype(np.float64)
    return float((velocity * mode).sum() / (mode**2).sum()) / 1.0e-4


@pytest.mark.parametrize("solver", ["explicit", "implicit"])
def test_a_swirl_decays_as_theory_says(taichi_cpu, solver):
    viscosity, steps = 0.01, 100
    # A tenth of the explicit limit, 0.125 d²/nu, so that both are exact in time to 1 %.
    dt = 0.0125 * SPACING**2 / viscosity
    fluid, mode = swirling_cylinder(viscosity=viscosity, viscosity_solver=solver, dt=dt)
    before = amplitude(fluid, mode)
    for _ in range(steps):
        fluid.substep(dt)
    rate = -np.log(amplitude(fluid, mode) / before) / (steps * dt)
    # Ten particles to the radius, and a surface that is no circle: the discrete operator is right to 10 % there.
    assert rate == pytest.approx(viscosity * WAVE_NUMBER**2, rel=0.1)


@pytest.mark.parametrize("stiffness", [1.0, 100.0])
def test_a_long_implicit_step_is_that_of_backward_euler(taichi_cpu, stiffness):
    viscosity, dt = 1.0, stiffness / WAVE_NUMBER**2
    fluid, mode = swirling_cylinder(viscosity=viscosity, viscosity_solver="implicit", dt=dt)
    before = amplitude(fluid, mode)
    fluid.substep(dt)
    # v' = v/(1 + nu k² dt); the discrete nu k² is right to 10 %, and the iteration to its tolerance.
    assert amplitude(fluid, mode) / before == pytest.approx(1.0 / (1.0 + stiffness), rel=0.1, abs=3.0 * TOLERANCE)
    state = fluid.diagnostics()
    # At nu dt = 400 d² the rounding of the changes alone, 6e-8 of each times that, is a residual beyond the tolerance;
    # the residual that conjugate gradients carry along knows nothing of it.
    assert (state["viscosity_error"] <= TOLERANCE) == (stiffness == 1.0)
    assert state["viscosity_error"] < 0.01
    assert state["not_converged"] == float(stiffness != 1.0)


def test_a_first_guess_that_is_worse_than_none_is_forgotten(taichi_cpu):
    particles = lattice((-0.1,) * 3, (0.1,) * 3, SPACING)
    velocities = np.random.default_rng(5).normal(0.0, 0.3, particles.shape).astype(np.float32)
    fluid = make_fluid(
        OPEN_SPACE,
        particles,
        velocities,
        gravity=(0.0, 0.0, 0.0),
        viscosity=1.0,
        viscosity_solver="implicit",
        artificial_viscosity=0.0,
    )
    fluid.substep(1.0e-3)
    stopped = dict(fluid.checkpoint())
    stopped["velocity"] = np.broadcast_to(np.float32((1.0, 2.0, 3.0)), velocities.shape).copy()
    # WCSPH pushes particles apart where they are compressed; where they have started nobody is.
    stopped["position"] = stopped["reference_position"] = particles[stopped["particle_id"]]
    fluid.restore(stopped)
    fluid.begin_frame(0.0)
    fluid.substep(1.0e-3)
    state = fluid.diagnostics()
    # The right-hand side is 0: there is nothing to reach a thousandth of by taking the guess back bit by bit.
    assert (state["viscosity_iterations"], state["viscosity_error"], state["not_converged"]) == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(fluid.snapshots()["water"].arrays["velocity"], stopped["velocity"])


def test_implicit_viscosity_conserves_momentum_and_takes_energy(taichi_cpu):
    particles = lattice((-0.1,) * 3, (0.1,) * 3, SPACING)
    velocities = np.random.default_rng(5).normal(0.0, 0.3, particles.shape).astype(np.float32)
    velocities += np.float32((0.5, 0.0, -0.2))
    fluid = make_fluid(
        OPEN_SPACE, particles, velocities, gravity=(0.0, 0.0, 0.0), viscosity=5.0, viscosity_solver="implicit"
    )
    position = fluid.snapshots()["water"].arrays["position"].astype(np.float64)

    def angular_momentum():
        now = fluid.snapshots()["water"].arrays
        return np.cross(now["position"].astype(np.float64), now["velocity"]).sum(axis=0)

    before, spin = fluid.diagnostics(), angular_momentum()
    for _ in range(20):
        fluid.substep(fluid.stable_dt())
    after = fluid.diagnostics()
    scale = before["mass"] * 0.6
    for axis in "xyz":
        # Pair forces cancel to float32 rounding (6e-8) of each of twenty kicks, wherever the iteration stopped.
        assert abs(after[f"momentum_{axis}"] - before[f"momentum_{axis}"]) < 1.0e-5 * scale
    # Pair forces lie along x_ij: the same for the angular momentum, against the sum of |x||v|.
    lever = np.linalg.norm(position, axis=1) * np.linalg.norm(velocities, axis=1)
    assert np.abs(angular_momentum() - spin).max() < 1.0e-5 * lever.sum()
    assert after["kinetic_energy"] < before["kinetic_energy"]
    assert after["viscosity_iterations"] >= 1.0


def test_a_rigid_motion_needs_no_iteration(taichi_cpu):
    particles = lattice((-0.1,) * 3, (0.1,) * 3, SPACING)
    velocities = np.broadcast_to(np.float32((3.0, -2.0, 1.0)), particles.shape).copy()
    fluid = make_fluid(
        OPEN_SPACE, particles, velocities, gravity=(0.0, 0.0, 0.0), viscosity=100.0, viscosity_solver="implicit"
    )
    fluid.substep(1.0e-3)
    assert fluid.diagnostics()["viscosity_iterations"] == 0.0
    np.testing.assert_array_equal(fluid.snapshots()["water"].arrays["velocity"], velocities)


def test_honey_takes_the_time_step_of_water(dam_break):
    water = dam_break(viscosity=1.0e-6)
    honey = dam_break(viscosity=10.0, wall_friction=1.0)
    assert honey.stable_dt() == pytest.approx(water.stable_dt())
    start = honey.snapshots()["water"].arrays["position"]
    for _ in range(200):
        honey.substep(honey.stable_dt())
        assert honey.first_bad_quantity() is None
    for _ in range(200):
        water.substep(water.stable_dt())
    assert honey.diagnostics()["not_converged"] == 0.0
    moved = [np.abs(fluid.snapshots()["water"].arrays["position"] - start).max() for fluid in (honey, water)]
    # Ten thousand times as viscous as glycerine, and stuck to walls: it creeps while water has fallen.
    assert moved[0] < 0.1 * moved[1]


def test_a_stiff_fluid_continues_from_a_checkpoint_bit_for_bit(dam_break):
    options = {"viscosity": 1.0, "wall_friction": 0.5, "viscosity_solver": "implicit"}
    straight, other = dam_break(**options), dam_break(**options)
    for _ in range(30):
        straight.substep(straight.stable_dt())
    other.restore(straight.checkpoint())
    for _ in range(30):
        straight.substep(straight.stable_dt())
        other.substep(other.stable_dt())
    for name, array in straight.checkpoint().items():
        np.testing.assert_array_equal(other.checkpoint()[name], array, err_msg=name)


@pytest.mark.parametrize(
    ("solver", "viscosity", "dt", "expected"),
    [
        ("auto", 1.0e-6, "adaptive", False),
        ("auto", 1.0, "adaptive", True),
        ("auto", 1.0, 1.0e-5, False),  # 0.125 d²/nu is 5e-5 s
        ("auto", 1.0, 1.0e-4, True),
        ("explicit", 1.0, "adaptive", False),
        ("implicit", 1.0e-6, "adaptive", True),
        ("implicit", 0.0, "adaptive", False),
    ],
)
def test_viscosity_is_solved_for_where_it_would_shorten_the_step(solver, viscosity, dt, expected):
    block = {"shape": {"type": "sphere", "radius": 1.0}}
    parameters = FluidParameters(name="water", block=[block], viscosity_solver=solver, dt=dt, particle_radius=0.01)
    assert is_implicit(parameters, viscosity, speed=30.0) is expected


@pytest.mark.parametrize("solver", ["explicit", "implicit"])
def test_a_viscosity_that_is_changed_between_frames_acts_as_it_does_from_the_start(taichi_cpu, solver):
    def decayed(start: float, then: float) -> np.ndarray:
        fluid, _ = swirling_cylinder(viscosity=start, viscosity_solver=solver)
        fluid.set_viscosity("water", then)
        dt = fluid.stable_dt()
        for _ in range(3):
            fluid.substep(dt)
        return np.array([dt, *fluid.snapshots()["water"].arrays["velocity"].ravel()])

    np.testing.assert_array_equal(decayed(0.003, 0.01), decayed(0.01, 0.01))


def test_a_viscosity_or_a_step_for_which_another_solver_would_be_built_is_refused(taichi_cpu):
    fluid, _ = swirling_cylinder(viscosity=1.0e-4)
    before = fluid.stable_dt()
    with pytest.raises(ValueError, match="viscosity would be implicit, which is decided at the start"):
        fluid.set_viscosity("water", 1.0)
    with pytest.raises(ValueError, match='"milk"'):
        fluid.set_viscosity("milk", 1.0e-4)
    with pytest.raises(ValueError, match="cfl must"):
        fluid.set_cfl(2.5)
    assert fluid.stable_dt() == before
    stiff, _ = swirling_cylinder(viscosity=1.0)
    with pytest.raises(ValueError, match="would be explicit"):
        stiff.set_viscosity("water", 1.0e-6)


@pytest.mark.parametrize("solver", ["wcsph", "dfsph", "pcisph"])
def test_steps_follow_the_factor_on_them(taichi_cpu, solver):
    points = lattice((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1), SPACING)
    fast = np.full_like(points, 3.0)
    fluid = make_fluid(OPEN_SPACE, points, fast, solver=solver, artificial_viscosity=0.0, gravity=(0.0, 0.0, 0.0))
    before = fluid.stable_dt()
    fluid.set_cfl(0.5)
    assert fluid.stable_dt() == pytest.approx(0.5 * before)
