"""Rigid bodies in free flight, against theory."""

import numpy as np
import pytest
from rigid_scenes import GRAVITY, advance, ball, body, cube, in_room, in_space, totals

from sim.core.motion import rotation


def test_free_fall_is_exact():
    solver = in_room(body("stone", ball(0.1), (0.1, 0.2, 3.0), velocity=(0.5, -0.2, 1.0)))
    advance(solver, 0.5, dt=1.7e-3)
    # Free flight under constant gravity is integrated exactly: rounding of three hundred additions.
    expected = [0.1 + 0.25, 0.2 - 0.1, 3.0 + 0.5 - 0.125 * GRAVITY]
    np.testing.assert_allclose(solver.bodies.position[0], expected, atol=1e-12)
    np.testing.assert_allclose(solver.bodies.velocity[0], [0.5, -0.2, 1.0 - 0.5 * GRAVITY], atol=1e-12)


@pytest.mark.parametrize("size", [(0.3, 0.2, 0.05), (0.1, 0.1, 0.4)])
def test_torque_free_rotation_keeps_angular_momentum_and_energy_for_ten_seconds(size):
    solver = in_space(body("brick", {"type": "box", "size": size}, angular_velocity=(3.0, -4.0, 2.0)))
    momentum, energy = totals(solver, "angular_momentum"), solver.diagnostics()["kinetic_energy"]
    worst = 0.0
    for _ in range(100):
        advance(solver, 0.1, dt=0.01)
        worst = max(worst, abs(solver.diagnostics()["kinetic_energy"] / energy - 1.0))
    # The spin is carried over as it is: rounding of 1000 steps. Required are 5e-3.
    drift = np.linalg.norm(totals(solver, "angular_momentum") - momentum) / np.linalg.norm(momentum)
    assert drift < 1e-10
    # Second order and symplectic: it oscillates by about a tenth of (omega dt)², that is (5.4 x 0.01)² / 10.
    assert worst < 5e-4


def test_rotation_about_the_shortest_and_longest_axis_is_stable():
    for axis in (0, 2):
        spin = np.full(3, 0.01)
        spin[axis] = 5.0
        solver = in_space(body("racket", {"type": "box", "size": (0.3, 0.2, 0.05)}, angular_velocity=tuple(spin)))
        for _ in range(50):
            advance(solver, 0.1, dt=0.02)
            # The disturbance of 0.01/5 in direction grows by the ratio of the rates at most, here under ten.
            assert solver.bodies.rotation()[0, :, axis] @ np.eye(3)[axis] > 1.0 - 0.5 * (10 * 0.014 / 5) ** 2


def test_a_symmetric_top_precesses_at_its_rate():
    # Free precession: the body's axis circles the angular momentum at L / I_1.
    solver = in_space(
        body("top", {"type": "cylinder", "radius": 0.1, "height": 0.05}, angular_velocity=(1.0, 0.0, 6.0))
    )
    momentum = totals(solver, "angular_momentum")
    rate = np.linalg.norm(momentum) / solver.bodies.principal_moments[0, 0]
    direction = momentum / np.linalg.norm(momentum)
    start = solver.bodies.rotation()[0, :, 2]
    expected = rotation.rotated(rotation.exponential(rate * 1.0 * direction), start)
    advance(solver, 1.0, dt=1e-3)
    # Second order: (omega dt)² / 10 of the 12 rad that the axis turned in this second is 5e-5.
    np.testing.assert_allclose(solver.bodies.rotation()[0, :, 2], expected, atol=1e-4)


def test_centre_of_mass_of_an_off_centre_body_flies_straight_and_its_origin_circles_it():
    solver = in_space(body("cone", {"type": "cone", "radius": 0.1, "height": 0.4}, angular_velocity=(6.0, 0.0, 0.0)))
    snapshot = solver.snapshots()["cone"]
    np.testing.assert_allclose(snapshot.arrays["position"], 0.0, atol=1e-12)
    # The centre of mass is a quarter of the height above the base: a tenth of a metre below the box's centre.
    np.testing.assert_allclose(solver.bodies.position[0], [0.0, 0.0, -0.1], atol=1e-5)
    np.testing.assert_allclose(snapshot.arrays["velocity"], np.cross([6.0, 0, 0], [0, 0, 0.1]), atol=1e-4)
    start = solver.bodies.position[0].copy()
    advance(solver, 0.3)
    np.testing.assert_allclose(solver.bodies.position[0], start, atol=1e-12)
    arrays = solver.snapshots()["cone"].arrays
    arm = rotation.rotated(arrays["orientation"], np.array([0.0, 0.0, -0.1]))
    np.testing.assert_allclose(arrays["position"] + arm, start, atol=1e-5)


def test_impulses_change_momentum_and_spin_by_just_that():
    solver = in_space(body("brick", {"type": "box", "size": (0.3, 0.2, 0.05)}, rotation_deg=(20, 40, 60)))
    linear, angular = np.array([[1.0, -2.0, 3.0]]), np.array([[0.3, 0.1, -0.2]])
    solver.bodies.apply_impulses(linear, angular)
    # Rounding of a few operations.
    np.testing.assert_allclose(totals(solver, "momentum"), linear[0], rtol=1e-12)
    np.testing.assert_allclose(solver.bodies.angular_momentum()[0], angular[0], rtol=1e-12)


def test_impulses_do_not_move_kinematic_bodies():
    solver = in_space(body("wall", cube(0.2), kind="kinematic", velocity=(1.0, 0.0, 0.0)))
    solver.bodies.apply_impulses(np.ones((1, 3)), np.ones((1, 3)))
    np.testing.assert_array_equal(solver.bodies.velocity, [[1.0, 0.0, 0.0]])
    assert not solver.bodies.inverse_mass.any()
    assert not solver.bodies.inverse_inertia().any()


def test_a_body_whose_weight_impulses_carry_stays_until_they_end():
    solver, dt = in_room(body("stone", ball(0.1), (0.0, 0.0, 1.0))), 1.7e-3
    weight = solver.bodies.mass[0] * GRAVITY
    for _ in range(100):
        solver.bodies.apply_impulses(np.array([[0.0, 0.0, weight * dt]]), np.zeros((1, 3)))
        solver.substep(dt)
    # Rounding of a hundred additions; with steps of free fall it would rise by g dt²/2 in each, 1.4 mm.
    np.testing.assert_allclose(solver.bodies.position[0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(solver.bodies.velocity[0], 0.0, atol=1e-12)
    for _ in range(100):
        solver.substep(dt)
    np.testing.assert_allclose(solver.bodies.position[0, 2], 1.0 - 0.5 * GRAVITY * (100 * dt) ** 2, atol=1e-12)
