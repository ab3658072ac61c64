"""Rigid bodies in a job file: what makes sense is taken, what does not is refused with a remedy."""

import numpy as np
import pytest
from pydantic import ValidationError
from rigid_scenes import ball

from sim.core.motion.paths import KeyframePath
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of


def parameters(**more) -> RigidBodyParameters:
    return RigidBodyParameters(**{"name": "thing", "shape": ball(0.1), **more})


KEYFRAMES = (
    {"time_s": 0.5, "position": (0, 0, 1)},
    {"time_s": 1.0, "position": (1, 0, 1), "rotation_deg": (0, 0, 90)},
    {"time_s": 2.0, "position": (1, 2, 1.5), "rotation_deg": (60, 0, 90)},
)

SENSELESS = {
    "dynamic without density": ({"kind": "dynamic"}, "density is missing; a dynamic body needs one"),
    "static with density": ({"density": 500}, "density has no meaning for a static body, got 500 kg/m³; remove it"),
    "kinematic with density": ({"kind": "kinematic", "density": 7}, "no meaning for a kinematic body, got 7 kg/m³"),
    "static with keyframes": ({"keyframe": KEYFRAMES}, 'a static body has no keyframes; .* use kind = "kinematic"'),
    "dynamic with keyframes": (
        {"kind": "dynamic", "density": 500, "keyframe": KEYFRAMES},
        "a dynamic body has no keyframes",
    ),
    "static with velocity": ({"velocity": (1, 0, 0)}, "velocity has no meaning for a static body; remove it"),
    "keyframes and velocity": (
        {"kind": "kinematic", "keyframe": KEYFRAMES, "angular_velocity": (1, 0, 0)},
        "angular_velocity of a body with keyframes comes from them",
    ),
    "two starting places": (
        {"kind": "kinematic", "keyframe": KEYFRAMES, "position": (3, 0, 0)},
        "position differs from that of the first keyframe",
    ),
    "a number for a starting place": (
        {"kind": "kinematic", "keyframe": KEYFRAMES, "position": 3},
        "Input should be a valid tuple",
    ),
    "lighter than any body": ({"kind": "dynamic", "density": 1e-320}, "greater than or equal to 0.001"),
    "ballast without mass": (
        {"kind": "kinematic", "ballast": ({"mass": 1, "position": (0, 0, 0)},)},
        'a kinematic body has no mass for ballast to add to; .* use kind = "dynamic"',
    ),
    "keyframes out of order": (
        {"kind": "kinematic", "keyframe": (KEYFRAMES[1], KEYFRAMES[0])},
        r"keyframe\[1\].time_s must be after 1 s, .* got 0.5 s",
    ),
    "interpolation of nothing": (
        {"kind": "kinematic", "interpolation": "linear"},
        r"interpolation has no meaning without keyframes; .* \[\[rigid.keyframe\]\]",
    ),
    "too much restitution": ({"restitution": 1.5}, "less than or equal to 1"),
    "negative friction": ({"friction": -0.1}, "greater than or equal to 0"),
}


@pytest.mark.parametrize(("given", "message"), SENSELESS.values(), ids=SENSELESS)
def test_senseless_mixes_are_refused(given, message):
    with pytest.raises(ValidationError, match=message):
        parameters(**given)


def test_body_with_keyframes_starts_at_the_first():
    body = parameters(kind="kinematic", keyframe=KEYFRAMES)
    assert (body.position, body.rotation_deg) == ((0, 0, 1), (0, 0, 0))
    assert RigidBodyParameters.model_validate(body.model_dump()).keyframe == body.keyframe


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
def test_path_passes_its_keyframes_and_rests_at_its_ends(interpolation):
    path = path_of(parameters(kind="kinematic", keyframe=KEYFRAMES, interpolation=interpolation))
    np.testing.assert_allclose(path.at(1.0).position, [1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(path.at(1.0).orientation, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    for outside, inside in ((0.0, 0.5), (7.0, 2.0)):
        motion = path.at(outside)
        np.testing.assert_allclose(motion.position, path.at(inside).position, atol=1e-12)
        assert not motion.velocity.any()
        assert not motion.angular_velocity.any()


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
@pytest.mark.parametrize("time_s", [0.6, 0.9, 1.3, 1.99])
def test_velocities_are_the_derivatives_of_the_path(interpolation, time_s):
    from sim.core.motion import rotation

    path = path_of(parameters(kind="kinematic", keyframe=KEYFRAMES, interpolation=interpolation))
    h = 1e-5
    before, now, after = (path.at(time_s + step) for step in (-h, 0.0, h))
    # Central differences err by h² and by rounding over h: both about 1e-10.
    np.testing.assert_allclose(now.velocity, (after.position - before.position) / (2 * h), atol=1e-8)
    turn = rotation.product(after.orientation, rotation.conjugate(before.orientation))
    np.testing.assert_allclose(now.angular_velocity, rotation.logarithm(turn) / (2 * h), atol=1e-8)


def test_cubic_path_has_continuous_velocities_and_the_linear_one_jumps():
    def jumps(interpolation: str) -> list[float]:
        path = path_of(parameters(kind="kinematic", keyframe=KEYFRAMES, interpolation=interpolation))
        sizes = []
        for time_s in (0.5, 1.0, 2.0):
            before, after = path.at(time_s - 1e-9), path.at(time_s + 1e-9)
            sizes += [np.abs(after.velocity - before.velocity).max()]
            sizes += [np.abs(after.angular_velocity - before.angular_velocity).max()]
        return sizes

    assert max(jumps("cubic")) < 1e-6  # accelerations of up to 100 m/s² times 2e-9 s
    assert min(jumps("linear")) > 0.1


def test_linear_path_turns_along_the_great_arc_at_constant_rate():
    path = path_of(parameters(kind="kinematic", keyframe=KEYFRAMES[:2], interpolation="linear"))
    np.testing.assert_allclose(path.at(0.75).angular_velocity, [0, 0, np.pi / 2 / 0.5], atol=1e-12)
    half = np.deg2rad(45.0) / 2
    np.testing.assert_allclose(path.at(0.75).orientation, [np.cos(half), 0, 0, np.sin(half)], atol=1e-12)


def test_equal_keyframes_are_a_path_at_rest():
    pose = np.array([[0.3, 0.1, 0.2]] * 3), np.array([[0.6, 0.8, 0.0, 0.0]] * 3)
    motion = KeyframePath([0.0, 1.0, 2.0], *pose, linear=False).at(1.4)
    np.testing.assert_allclose(motion.position, pose[0][0], atol=1e-15)
    np.testing.assert_allclose(motion.orientation, pose[1][0], atol=1e-15)
    assert np.abs(motion.angular_velocity).max() < 1e-15


def test_body_without_keyframes_keeps_its_velocities():
    path = path_of(parameters(kind="kinematic", position=(1, 0, 0), velocity=(0, 2, 0), angular_velocity=(0, 0, np.pi)))
    motion = path.at(0.5)
    np.testing.assert_allclose(motion.position, [1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(motion.orientation, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
