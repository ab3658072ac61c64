"""Emitters that move: along keyframes, on kinematic bodies and on dynamic ones."""

import numpy as np
import pytest

from sim.build import build_world
from sim.core.motion import rotation
from sim.rigid.paths import path_of
from sim.scene import SceneParameters

RADIUS, FPS = 0.01, 50.0
OPEN = {"min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0), "open_faces": ("x-", "x+", "y-", "y+", "z-", "z+")}
HOSE = {"shape": {"type": "rectangle", "size": (0.08, 0.08)}, "direction": (0, 0, -1), "speed": 1.0}
TILTING = [
    {"time_s": 0.0, "position": (0.0, 0.0, 0.6)},
    {"time_s": 0.3, "position": (0.1, 0.0, 0.7), "rotation_deg": (0.0, -60.0, 0.0)},
]
BOTTLE = {"name": "bottle", "shape": {"type": "box", "size": (0.1, 0.1, 0.1)}, "position": (0.0, 0.0, 0.6)}
ON_BOTTLE = {**HOSE, "position": (0.0, 0.0, -0.06), "follow": "bottle"}


def world_of(emitter: dict, *bodies: dict, gravity=(0.0, 0.0, 0.0), **fluid: object):
    scene = {
        "domain": OPEN,
        "gravity": gravity,
        "rigid": bodies,
        "fluid": [{"name": "w", "solver": "dfsph", "particle_radius": RADIUS, "emitter": [emitter], **fluid}],
    }
    return build_world(SceneParameters.model_validate(scene), frames_per_second=FPS)


def newest(world, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean position and velocity of the newest layer."""
    arrays = world.snapshots()["w"].arrays
    return arrays["position"][-count:].mean(axis=0), arrays["velocity"][-count:].mean(axis=0)


def advance(world, frames: int) -> dict:
    for _ in range(frames):
        report = world.advance_frame()
    return report.diagnostics["w"]


@pytest.mark.parametrize("how", ["keyframes", "kinematic"])
def test_fluid_leaves_a_moving_opening_with_its_motion_on_top(taichi_cpu, how):
    body = {**BOTTLE, "kind": "kinematic", "keyframe": TILTING}
    below = np.array([0.0, 0.0, -0.06])
    world = world_of(ON_BOTTLE, body) if how == "kinematic" else world_of({**HOSE, "keyframe": TILTING})
    opening = world.solvers["w"].tank.emission.openings[0]
    arm = below if how == "kinematic" else np.zeros(3)
    count = len(opening.places)
    assert count == 16
    path = path_of(SceneParameters.model_validate({"domain": OPEN, "rigid": [body]}).rigid[0])
    emitted = 0
    for frame in range(1, 14):
        now = advance(world, 1)
        assert now["particles_emitted"] == pytest.approx(frame / FPS * 1.0 / opening.layer_distance * count, abs=count)
        if now["particles_emitted"] == emitted:
            continue
        emitted = now["particles_emitted"]
        layer = world.solvers["w"].tank.emission.openings[0].layers_due(frame / FPS) - 1
        left_s = opening.leaves_at(layer)
        pose = path.at(left_s)
        turned = rotation.rotated(pose.orientation, np.array([0.0, 0.0, -1.0]))
        place = pose.position + rotation.rotated(pose.orientation, arm) + 0.5 * opening.layer_distance * turned
        velocity = pose.velocity + np.cross(pose.angular_velocity, place - pose.position) + turned
        position, found = newest(world, count)
        # Within 1 % of its speed; pressures of a jet that bends show in layers that have been out for longer.
        np.testing.assert_allclose(
            found, velocity, atol=0.01 * np.linalg.norm(velocity) + 0.02 * (frame / FPS > left_s + 5e-3)
        )
        np.testing.assert_allclose(position, place + (frame / FPS - left_s) * velocity, atol=0.02 * 2 * RADIUS)
    assert now["emission_blocked"] == 0.0


def test_fluid_leaves_a_falling_body_that_falls_as_without_it(taichi_cpu):
    body = {**BOTTLE, "kind": "dynamic", "density": 500.0, "velocity": (0.4, 0.0, 1.0)}
    world = world_of({**ON_BOTTLE, "direction": (1, 0, 0), "position": (0.06, 0.0, 0.0)}, body, gravity=(0, 0, -9.81))
    now = advance(world, 8)
    # Both fall alike: of the jet nothing but the speed of the inflow is seen from the body.
    position, velocity = newest(world, 16)
    time_s = 8 / FPS
    np.testing.assert_allclose(velocity, [1.4, 0.0, 1.0 - 9.81 * time_s], atol=0.02)
    opening = world.solvers["w"].tank.emission.openings[0]
    out_s = time_s - opening.leaves_at(opening.layers_due(time_s) - 1)
    centre = np.array([0.4 * time_s, 0.0, 0.6 + time_s - 0.5 * 9.81 * time_s**2])
    ahead = 0.06 + 0.5 * opening.layer_distance + out_s * 1.0
    np.testing.assert_allclose(position, centre + np.array([ahead, 0.0, 0.0]), atol=0.05 * 2 * RADIUS)
    assert now["particles_emitted"] == 7 * 16  # the volume of a particle is d³ and a little more


def test_an_emitter_on_a_static_body_stands_with_it(taichi_cpu):
    tap = {**BOTTLE, "rotation_deg": (0.0, 90.0, 0.0)}
    opening = world_of(ON_BOTTLE, tap).solvers["w"].tank.emission.openings[0]
    assert not opening.moves
    np.testing.assert_allclose(
        opening.points(1).mean(axis=0), [-0.06 - 0.5 * opening.layer_distance, 0.0, 0.6], atol=1e-9
    )
    np.testing.assert_allclose(opening.direction(opening.placement), [-1.0, 0.0, 0.0], atol=1e-12)


def test_a_body_that_is_not_there_and_a_piece_of_one_that_breaks_are_refused(taichi_cpu):
    with pytest.raises(ValueError, match=r'fluid "w" emitter\[0\]: no rigid body is named "bottle"'):
        world_of(ON_BOTTLE)
    breaks = {"kind": "dynamic", "density": 500.0, "breaks": {"strength": 1e6, "pieces": 2}}
    with pytest.raises(ValueError, match=r'fluid "w" emitter\[0\]: "bottle_1" is a piece of "bottle", which breaks'):
        world_of({**ON_BOTTLE, "follow": "bottle_1"}, BOTTLE | breaks)


@pytest.mark.parametrize("kind", ["kinematic", "dynamic"])
def test_a_moving_emission_continues_from_a_checkpoint_bit_for_bit(taichi_cpu, kind):
    body = {**BOTTLE, "kind": kind}
    body |= {"keyframe": TILTING} if kind == "kinematic" else {"density": 300.0, "angular_velocity": (0.0, 4.0, 1.0)}
    ramp = [{"time_s": 0.0, "strength": 0.2}, {"time_s": 0.2, "strength": 1.0}]
    emitter = {**ON_BOTTLE, "ramp": ramp, "total_volume": 0.0015}

    def fresh():
        return world_of(emitter, body, gravity=(0.0, 0.0, -9.81))

    straight, other = fresh(), fresh()
    advance(straight, 5)
    saved = straight.checkpoint()
    other.restore(5, saved)
    for world in (straight, other):
        now = advance(world, 8)
    assert now["particles_emitted"] > 100.0
    restored = other.checkpoint()
    for name, array in straight.checkpoint().items():
        np.testing.assert_array_equal(restored[name], array, err_msg=name)
