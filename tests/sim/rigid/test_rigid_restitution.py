"""Impacts never add energy, and give back what restitution says where theory knows it."""

import numpy as np
import pytest
from rigid_scenes import SPACE, advance, ball, body, cube, energy, in_room, in_space, totals

from sim.rigid.solver import RigidSolver

BRICK = {"type": "box", "size": (0.4, 0.2, 0.05)}
ROUNDING = 1e-5
"""Of the energy: a fast tumbling body's free rotation errs by so much in a second (3e-6 measured); impacts add none."""


def thrown(seed: int, shape: dict, restitution: float, friction: float) -> RigidSolver:
    """A tumbling body without gravity that will hit a plate with an edge or a corner."""
    random = np.random.default_rng(seed)
    surface = {"restitution": restitution, "friction": friction}
    plate = body("plate", {"type": "box", "size": (4.0, 4.0, 0.2)}, (0, 0, -0.1), kind="static", **surface)
    motion = {
        "rotation_deg": tuple(random.uniform(-180, 180, 3)),
        "velocity": (*random.uniform(-2, 2, 2), -random.uniform(1, 3)),
        "angular_velocity": tuple(random.uniform(-8, 8, 3)),
    }
    return RigidSolver(
        [body("body", shape, (0, 0, 0.4), **motion, **surface)], obstacles=[plate], domain=SPACE, gravity=(0, 0, 0)
    )


def largest_gain(solver: RigidSolver, duration_s: float) -> float:
    """The largest gain of energy in ten milliseconds, over the energy at the start; the body must have lost some."""
    energies = [energy(solver)]
    while len(energies) <= 100 * duration_s:
        advance(solver, 0.01)
        energies.append(energy(solver))
    return float(np.diff(energies).max()) / energies[0]


@pytest.mark.parametrize("friction", [0.3, 1.0])
@pytest.mark.parametrize("restitution", [0.8, 1.0])
@pytest.mark.parametrize("shape", [cube(0.2), BRICK], ids=["cube", "brick"])
def test_oblique_impacts_with_friction_and_restitution_never_add_energy(shape, restitution, friction):
    for seed in range(3):
        solver = thrown(seed, shape, restitution, friction)
        start = energy(solver)
        assert largest_gain(solver, 0.4) < ROUNDING
        assert energy(solver) < 0.99 * start  # it did hit the plate, and friction took something


def test_elastic_impacts_without_friction_keep_the_energy_of_a_tumbling_box():
    for seed in range(3):
        solver = thrown(seed, cube(0.2), 1.0, 0.0)
        start, momentum = energy(solver), totals(solver, "momentum")
        advance(solver, 0.4)
        assert np.linalg.norm(totals(solver, "momentum") - momentum) > 0.5 * np.linalg.norm(momentum)
        assert energy(solver) == pytest.approx(start, rel=ROUNDING)


def test_box_that_lands_on_four_corners_at_once_gains_nothing():
    sliding = {"velocity": (1.5, 0.5, -2.0), "angular_velocity": (0, 0, 3), "restitution": 1.0, "friction": 0.8}
    solver = in_room(body("box", cube(0.2), (0, 0, 0.3), **sliding))
    start = energy(solver)
    gain = largest_gain(solver, 1.0)
    # Where corners are brought to the instant of their impact the box may be lifted by a part of the way of a step,
    # g dt² = 0.04 mm of the height of 0.4 m that its energy is worth.
    assert gain < 1e-4
    assert 0.3 * start < energy(solver) < start


def test_collisions_of_rough_bodies_gain_no_energy_and_keep_both_momenta():
    for seed, restitution in enumerate((1.0, 1.0, 1.0, 0.8)):
        random = np.random.default_rng(seed)
        surface = {"restitution": restitution, "friction": 1.0}
        spins = [tuple(random.uniform(-6, 6, 3)) for _ in range(3)]
        solver = in_space(
            body("a", cube(0.2), (-0.4, 0.03, 2), velocity=(2, 0, 0), angular_velocity=spins[0], **surface),
            body("b", BRICK, (0, 0, 2), angular_velocity=spins[1], **surface),
            body("c", cube(0.1), (0.4, -0.03, 2), velocity=(-2, 0, 0), angular_velocity=spins[2], **surface),
        )
        start = energy(solver)
        momenta = [totals(solver, name) for name in ("momentum", "angular_momentum")]
        assert largest_gain(solver, 0.5) < ROUNDING
        assert energy(solver) < 0.999 * start  # they did collide
        for name, before in zip(("momentum", "angular_momentum"), momenta, strict=True):
            # Of what each body has: the totals nearly cancel. Impulses are equal and opposite at one point.
            assert np.linalg.norm(totals(solver, name) - before) < 1e-12 * 8.0


def test_head_on_impact_of_a_cube_returns_its_restitution_with_friction_too():
    for restitution in (0.5, 0.8, 1.0):
        surface = {"restitution": restitution, "friction": 1.0}
        solver = in_space(
            body("left", cube(0.2), (-0.3, 0, 1), velocity=(1, 0, 0), **surface),
            body("right", cube(0.2), (0.3, 0, 1), velocity=(-1, 0, 0), **surface),
        )
        advance(solver, 0.6)
        # Four contacts share a central impact, where Newton's and Stronge's restitution agree: the solver's tolerance.
        np.testing.assert_allclose(solver.bodies.velocity[:, 0], [-restitution, restitution], rtol=1e-5)
        np.testing.assert_allclose(solver.bodies.angular_velocity, 0.0, atol=1e-4)


def test_a_bounce_does_not_depend_on_an_impact_elsewhere():
    bouncing = body("ball", ball(0.1), (-1, -1, 0.3), velocity=(0, 0, -1), restitution=1.0)
    edgewise = body(
        "box", cube(0.2), (1, 1, 0.4), rotation_deg=(30, 50, 10), velocity=(2, 0, -3), restitution=1.0, friction=1.0
    )
    alone, together = in_room(bouncing), in_room(bouncing, edgewise)
    advance(alone, 0.3, dt=1e-3)
    advance(together, 0.3, dt=1e-3)
    # The last sweep of the solver sees the largest change of all contacts: its tolerance, 1e-6 of the speed.
    np.testing.assert_allclose(together.bodies.velocity[0], alone.bodies.velocity[0], rtol=1e-5, atol=1e-9)
