"""Soft matter and rigid bodies: momentum, light bodies, craters, and bodies that stand or are led."""

from typing import Any

import numpy as np
import pytest

from sim.build import build_world
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SPACE = {"gravity": (0.0, 0.0, 0.0), "domain": {"min": (-0.6, -0.6, -0.6), "max": (0.6, 0.6, 0.6)}}
JELLY = {
    "name": "jelly",
    "material": "jelly",
    "block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}}],
}
BALL = {"name": "ball", "kind": "dynamic", "shape": {"type": "sphere", "radius": 0.06}, "density": 1000.0}


def world_of(**tables: Any) -> Any:
    return build_world(SceneParameters.model_validate({**SPACE, **tables}), frames_per_second=60)


def linear_and_angular(world: Any) -> tuple[np.ndarray, np.ndarray]:
    """Momentum, and angular momentum about the origin, of all that moves."""
    soft, rigid = world.solvers["soft"], world.solvers["rigid"]
    x, v = (np.asarray(each, np.float64) for each in soft.view("jelly").values())
    mass = soft.mass / len(x)
    affine = soft.particles.affine.to_numpy().astype(np.float64).reshape(3, 3, -1)
    carried = 0.25 * soft.parameters[0].cell_size ** 2 * affine
    lower, upper = carried[[2, 0, 1], [1, 2, 0]], carried[[1, 2, 0], [2, 0, 1]]
    bodies = rigid.bodies
    linear = mass * v.sum(axis=0) + (bodies.mass[:, None] * bodies.velocity).sum(axis=0)
    angular = mass * (np.cross(x, v) + (lower - upper).T).sum(axis=0) + bodies.angular_momentum().sum(axis=0)
    angular += (bodies.mass[:, None] * np.cross(bodies.position, bodies.velocity)).sum(axis=0)
    return linear, angular


@pytest.mark.parametrize("density", [1000.0, 20.0])
def test_a_ball_that_hits_jelly_gives_it_what_it_loses(density):
    ball = BALL | {"density": density, "position": (-0.25, 0.05, 0.0), "velocity": (3.0, 0.0, 0.0)}
    world = world_of(soft=[JELLY], rigid=[ball | {"angular_velocity": (0.0, 20.0, 10.0)}])
    linear, angular = linear_and_angular(world)
    for _ in range(8):
        world.advance_frame()
    now = linear_and_angular(world)
    ball_speed = world.solvers["rigid"].bodies.velocity[0]
    assert np.linalg.norm(ball_speed - (3.0, 0.0, 0.0)) > 0.3
    np.testing.assert_allclose(now[0], linear, atol=1e-5 * np.linalg.norm(linear))
    np.testing.assert_allclose(now[1], angular, atol=1e-5 * max(np.linalg.norm(angular), np.linalg.norm(linear) * 0.1))


def test_a_ball_as_light_as_a_bubble_rests_in_the_hand_of_jelly_that_flies():
    """Jelly a hundred times as heavy as the shell in front of it: they fly on together, and nothing shakes."""
    jelly = JELLY | {"block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "velocity": (1.0, 0.0, 0.0)}]}
    world = world_of(soft=[jelly], rigid=[BALL | {"density": 5.0, "position": (0.162, 0.0, 0.0)}])
    speeds = []
    for _ in range(10):
        world.advance_frame()
        speeds.append(world.solvers["rigid"].bodies.velocity[0])
    assert all(0.9 < speed[0] < 2.0 for speed in speeds[1:])  # hit without bounce, then thrown by what springs back
    assert np.abs(np.array(speeds)[:, 1:]).max() < 0.05
    assert world.solvers["soft"].diagnostics()["max_speed"] < 3.0


def test_jelly_carries_off_what_it_sticks_to_and_keeps_its_momentum():
    jelly = JELLY | {
        "block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "velocity": (-1.0, 0.0, 0.0)}],
        "sticks_to": ["ball"],
    }
    for sticks in (True, False):
        loose = jelly if sticks else jelly | {"sticks_to": []}
        world = world_of(soft=[loose], rigid=[BALL | {"position": (0.155, 0.0, 0.0)}])
        linear, angular = linear_and_angular(world)
        for _ in range(15):
            world.advance_frame()
        now = linear_and_angular(world)
        np.testing.assert_allclose(now[0], linear, atol=1e-5 * np.linalg.norm(linear))
        np.testing.assert_allclose(now[1], angular, atol=1e-5 * 0.1 * np.linalg.norm(linear))
        together = linear[0] / (world.solvers["soft"].mass + float(world.solvers["rigid"].bodies.mass[0]))
        assert world.solvers["rigid"].bodies.velocity[0, 0] == pytest.approx(together if sticks else 0.0, abs=0.35)


def test_soft_matter_cannot_stick_to_what_is_not_there():
    with pytest.raises(ValueError, match='"bal" is the name of no rigid body or group'):
        SceneParameters.model_validate({**SPACE, "soft": [JELLY | {"sticks_to": ["bal"]}], "rigid": [BALL]})


@pytest.mark.slow
def test_a_faster_ball_makes_a_deeper_crater():
    tray = {
        "gravity": (0.0, 0.0, -9.81),
        "domain": {"min": (-0.16, -0.16, 0.0), "max": (0.16, 0.16, 0.6)},
        "soft": [
            {
                "name": "sand",
                "material": "sand",
                "young_modulus": 1.0e5,
                "block": [{"shape": {"type": "box", "size": (0.32, 0.32, 0.16)}, "position": (0.0, 0.0, 0.08)}],
            }
        ],
    }
    depths = []
    for speed in (0.5, 4.0):
        ball = BALL | {"density": 1000.0, "position": (0.0, 0.0, 0.23), "velocity": (0.0, 0.0, -speed)}
        world = world_of(**tray, rigid=[ball])
        for _ in range(15):
            world.advance_frame()
        depths.append(0.16 - (world.solvers["rigid"].bodies.position[0, 2] - 0.06))
        assert abs(world.solvers["rigid"].bodies.velocity[0, 2]) < 0.3
    assert 0.0 < depths[0] < 0.8 * depths[1] < 0.12


@pytest.mark.parametrize("kind", ["static", "kinematic"])
def test_nothing_gets_into_a_body_that_stands_or_is_led(kind):
    table = {
        "name": "table",
        "kind": kind,
        "shape": {"type": "box", "size": (0.4, 0.4, 0.1)},
        "position": (0.0, 0.0, -0.2),
    }
    if kind == "kinematic":
        table |= {
            "keyframe": [{"time_s": 0.0, "position": (0.0, 0.0, -0.2)}, {"time_s": 0.2, "position": (0.0, 0.0, 0.0)}]
        }
        del table["position"]
    jelly = JELLY | {"block": [{"shape": {"type": "box", "size": (0.2, 0.2, 0.1)}}]}
    world = world_of(gravity=(0.0, 0.0, -9.81), soft=[jelly], rigid=[table])
    for _ in range(15):
        world.advance_frame()
        place = world.snapshots()["jelly"].arrays["position"]
        top = world.snapshots()["table"].arrays["position"][2] + 0.05
        assert place[:, 2].min() > top - 0.01  # half a cell
    assert world.solvers["soft"].diagnostics()["max_speed"] < 3.0


@pytest.mark.parametrize("is_greased", [False, True])
def test_a_body_that_is_greased_between_frames_lets_jelly_slide(is_greased):
    table = {"name": "table", "shape": {"type": "box", "size": (1.2, 0.6, 0.1)}, "position": (0.0, 0.0, -0.15)}
    block = {"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "velocity": (1.0, 0.0, 0.0), "position": (-0.3, 0, 0)}
    table |= {"kind": "kinematic", "friction": 0.8}
    jelly = JELLY | {"block": [block], "friction": 0.8}
    world = world_of(gravity=(0.0, 0.0, -9.81), soft=[jelly], rigid=[table])
    if is_greased:
        world.solvers["rigid"].set_surface("table", friction=0.0)
    for _ in range(9):
        world.advance_frame()
    speed = world.snapshots()["jelly"].arrays["velocity"][:, 0].mean()
    assert speed == pytest.approx(1.0, abs=0.02) if is_greased else speed < 0.5
