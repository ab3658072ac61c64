"""Joints in a job file: what makes sense is taken, what does not is refused with a remedy."""

import pytest
from pydantic import ValidationError
from rigid_scenes import ball, body, cube

from sim.build import build_world
from sim.rigid.joint_parameters import JointParameters, joint_problems
from sim.scene import SceneParameters

POINT, AXIS = (0, 0, 1), (0, 1, 0)
HINGE = {"kind": "hinge", "anchor": POINT, "axis": AXIS}
SLIDER = {"kind": "slider", "axis": AXIS}

SENSELESS = {
    "hinge without an axis": ({"kind": "hinge", "anchor": POINT}, "axis is missing; a hinge needs it"),
    "hinge without anything": ({"kind": "hinge"}, "anchor and axis are missing; a hinge needs it"),
    "spring without stiffness": ({"kind": "spring"}, "stiffness is missing; a spring needs it"),
    "axis of no length": ({**HINGE, "axis": (0, 0, 0)}, "has no direction; give it a length above 0"),
    "anchor of a rope": ({"kind": "rope", "anchor": POINT}, "anchor has no meaning for a rope, only for fixed or"),
    "limits of a hinge in metres": ({**HINGE, "limits": (-1, 1)}, "limits has no meaning for a hinge, only for slider"),
    "limits that exclude the start": ({**HINGE, "limits_deg": (10, 20)}, "10 to 20 excludes the start, where it is 0"),
    "limits the wrong way round": ({**HINGE, "limits_deg": (20, -10)}, "must be the lower and the upper one"),
    "cone without axis": ({"kind": "ball", "anchor": POINT, "cone_deg": 20}, "needs both axis and cone_deg"),
    "motor of a ball": (
        {"kind": "ball", "anchor": POINT, "motor": {"speed": 1, "max_torque": 1}},
        "motor has no meaning for a ball, only for hinge or slider",
    ),
    "motor without a limit": (
        {**HINGE, "motor": {"speed": 1}},
        r"the motor has no max_torque; give the most that it can \[N m\]",
    ),
    "motor of a slider without a limit": ({**SLIDER, "motor": {"speed": 1}}, r"has no max_force; .* \[N\]"),
    "motor with the wrong limit": (
        {**HINGE, "motor": {"speed": 1, "max_torque": 1, "max_force": 1}},
        "the motor of a hinge has a max_torque, no max_force; remove that",
    ),
    "position of a hinge": (
        {**HINGE, "motor": {"position": 1, "max_torque": 1}},
        "the motor of a hinge has angle_deg, no position; use that",
    ),
    "motor with two aims": (
        {**HINGE, "motor": {"position": 1, "speed": 2, "max_torque": 1}},
        "needs one of speed, angle_deg and position, got speed and position",
    ),
    "motor without an aim": ({**HINGE, "motor": {"max_torque": 1}}, "got none"),
    "response of a speed": (
        {**HINGE, "motor": {"speed": 1, "max_torque": 1, "response_s": 1}},
        "response_s has no meaning for a speed",
    ),
    "motor beyond the limits": (
        {**HINGE, "limits_deg": (-10, 10), "motor": {"angle_deg": 20, "max_torque": 1}},
        "the motor's angle_deg 20 is beyond the limits -10 to 10",
    ),
    "a body joined to itself": ({**HINGE, "between": ("a", "a")}, 'joins "a" to itself; name another body'),
    "three bodies": ({**HINGE, "between": ("a", "b", "c")}, "at most 2 items"),
}


@pytest.mark.parametrize("case", SENSELESS)
def test_a_joint_that_makes_no_sense_is_refused_with_a_remedy(case):
    given, message = SENSELESS[case]
    with pytest.raises(ValidationError, match=message):
        JointParameters(**{"name": "joint", "between": ("a", "b"), **given})


BODIES = (
    body("a", ball(0.1), (0, 0, 1)),
    body("b", ball(0.1), (0.5, 0, 1)),
    body("post", cube(0.1), (1, 0, 1), kind="static"),
    body("wall", cube(0.1), (2, 0, 1), kind="static"),
    body("hand", cube(0.1), (3, 0, 1), kind="kinematic"),
)

OF_SCENES = {
    "no such body": ([{"between": ("a", "c"), **HINGE}], 'between names no rigid body with "c"; rigid bodies are a, b'),
    "bodies that never move": (
        [{"between": ("post", "wall"), **HINGE}],
        'between cannot move: "post" is static and "wall" is static, which no force moves; make one kind = "dynamic"',
    ),
    "a led body and the world": ([{"between": ("hand",), **HINGE}], 'cannot move: "hand" is kinematic'),
    "held twice": (
        [{"between": ("a", "b"), "kind": "fixed"}, {"between": ("b", "a"), **HINGE}],
        'between are held by joint "j0" already',
    ),
    "held twice to what stands": (
        [{"between": ("a",), **HINGE}, {"between": ("a", "post"), **HINGE}],
        'between are held by joint "j0" already',
    ),
    "the same name": (
        [{"between": ("a",), **HINGE, "name": "x"}, {"between": ("b",), **HINGE, "name": "x"}],
        'name "x" is taken by joint[0]',
    ),
    "rope to nowhere": (
        [{"between": ("a",), "kind": "rope"}],
        "anchors are missing; a rope to the world needs its two",
    ),
    "rope too short": (
        [{"between": ("a", "b"), "kind": "rope", "length": 0.4}],
        "length 0.4 m excludes the start, where the points are 0.5 m apart; make it longer",
    ),
    "rod whose ends are apart": (
        [{"between": ("a", "b"), "kind": "distance", "length": 0.6}],
        "length must be that at the start, where the points are 0.5 m apart, got 0.6 m",
    ),
    "spring of no length": (
        [{"between": ("a", "b"), "kind": "spring", "stiffness": 1, "anchors": (POINT, POINT)}],
        "anchors its two points are one, and a spring between them has no direction",
    ),
    "rope of no length": (
        [{"between": ("a", "b"), "kind": "rope", "anchors": (POINT, POINT)}],
        "its two points are one; give the rope a length",
    ),
}


@pytest.mark.parametrize("case", OF_SCENES)
def test_joints_that_cannot_be_are_told_with_a_remedy(case):
    given, message = OF_SCENES[case]
    joints = [JointParameters(**{"name": f"j{number}", **each}) for number, each in enumerate(given)]
    (problem,) = joint_problems(joints, BODIES)
    assert message in problem.text
    with pytest.raises(ValueError, match='joint "') as refused:
        build_world(SceneParameters(rigid=BODIES, joint=tuple(joints)), frames_per_second=60)
    assert message in str(refused.value)


AT_CLOTH = {
    "hinge": ({"between": ("a", "sail"), **HINGE}, 'kind is a hinge at the cloth "sail", a point of which has no'),
    "fixed": ({"between": ("sail", "a"), "kind": "fixed", "anchor": POINT}, "use a ball, a distance, a spring or a"),
    "cone": (
        {"between": ("a", "sail"), "kind": "ball", "anchor": POINT, "axis": AXIS, "cone_deg": 20},
        'cone_deg is about an axis of the cloth "sail"',
    ),
    "world": (
        {"between": ("sail",), "kind": "ball", "anchor": POINT},
        'between joins the cloth "sail" to the world; hold it there by a [[cloth.pin]]',
    ),
    "static body": (
        {"between": ("post", "sail"), "kind": "rope", "anchors": (POINT, POINT)},
        'joins the cloth "sail" to "post", which is static',
    ),
    "kinematic body": (
        {"between": ("hand", "sail"), "kind": "ball", "anchor": POINT},
        'to "hand", which is kinematic; hold it there by a [[cloth.pin]] with such keyframes',
    ),
    "two cloths": (
        {"between": ("jib", "sail"), "kind": "rope", "anchors": (POINT, POINT)},
        'joins the cloths "jib" and "sail"; join both to a body',
    ),
    "no anchors": (
        {"between": ("a", "sail"), "kind": "rope"},
        "anchors are missing; a rope to a cloth needs its two points",
    ),
    "no length": (
        {"between": ("a", "sail"), "kind": "distance", "anchors": (POINT, POINT)},
        "anchors its two points are one",
    ),
    "unknown": (
        {"between": ("a", "sial"), "kind": "ball", "anchor": POINT},
        'names no rigid body with "sial"; rigid bodies are a, b, post, wall, hand; cloths are sail, jib',
    ),
}


@pytest.mark.parametrize("case", AT_CLOTH)
def test_joints_to_cloth_that_cannot_be_are_told_with_a_remedy(case):
    given, message = AT_CLOTH[case]
    (problem,) = joint_problems([JointParameters(name="j", **given)], BODIES, ("sail", "jib"))
    assert message in problem.text


def test_what_makes_sense_is_taken():
    joints = [
        JointParameters(name="two", between=("a", "b"), kind="ball", anchor=POINT),
        JointParameters(name="balls", between=("a", "b"), kind="ball", anchor=(0, 1, 1)),
        JointParameters(name="rope", between=("a", "b"), kind="rope"),
        JointParameters(name="led", between=("a", "hand"), kind="slider", axis=AXIS, limits=(0, 2)),
        JointParameters(name="stands", between=("b", "post"), kind="fixed"),
        JointParameters(name="hook", between=("b", "sail"), kind="ball", anchor=POINT),
        JointParameters(name="sheet", between=("sail", "a"), kind="rope", anchors=((3, 0, 1), POINT)),
    ]
    assert not list(joint_problems(joints, BODIES, ("sail",)))
