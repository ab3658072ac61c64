"""Groups of rigid bodies: which bodies a table makes, the same ones everywhere, and what it refuses."""

from __future__ import annotations

import hashlib
import json
from itertools import combinations, pairwise

import numpy as np
import pytest
from pydantic import ValidationError
from rigid_scenes import ball, body, cube

from sim.core.motion.rotation import from_degrees, rotated
from sim.core.parameters import KeyRefusedError
from sim.rigid.groups import with_groups
from sim.rigid.parameters import RigidBodyParameters
from sim.scene import SceneParameters
from sim.shapes.extent import ball_around, box_around, depth_inside
from sim.shapes.groups import SIZES
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

BRICK = {"type": "box", "size": (0.1, 0.05, 0.04)}
BOX = {"shape": {"type": "box", "size": (0.6, 0.5, 0.4)}}


def group(shape=BRICK, *, name="brick", position=(0.0, 0.0, 0.0), **keys) -> tuple[RigidBodyParameters, ...]:
    return with_groups((body(name, shape, position, **keys),))


def places(bodies) -> np.ndarray:
    return np.array([each.position for each in bodies])


def test_a_lattice_counts_along_x_then_y_then_z_from_its_first_body():
    bodies = group(position=(1.0, 2.0, 0.02), count=(3, 2, 2), spacing=(0.11, 0.06, 0.04))
    assert [each.name for each in bodies] == [f"brick_{number}" for number in range(1, 13)]
    assert bodies[0].position == (1.0, 2.0, 0.02)
    assert bodies[1].position == pytest.approx((1.11, 2.0, 0.02), abs=1e-12)
    assert bodies[3].position == pytest.approx((1.0, 2.06, 0.02), abs=1e-12)
    assert bodies[6].position == pytest.approx((1.0, 2.0, 0.06), abs=1e-12)
    assert {(each.group, each.model, each.table) for each in bodies} == {("brick", "brick_1", 0)}
    assert {each.density for each in bodies} == {500.0}


def test_every_second_storey_is_shifted_and_the_whole_is_turned_with_its_bodies():
    bond = group(count=(2, 1, 3), spacing=0.1, offset=(0.05, 0.0, 0.0))
    assert places(bond)[:, 0].reshape(3, 2) == pytest.approx(np.array([[0.0, 0.1], [0.05, 0.15], [0.0, 0.1]]))
    turned = group(count=(2, 1, 3), spacing=0.1, offset=(0.05, 0.0, 0.0), rotation_deg=(0.0, 0.0, 30.0))
    assert places(turned) == pytest.approx(rotated(from_degrees((0.0, 0.0, 30.0)), places(bond)), abs=1e-9)
    assert {each.rotation_deg for each in turned} == {(0.0, 0.0, 30.0)}


def test_bodies_that_stand_on_their_end_keep_their_turn_along_a_curve():
    """At 90 degrees about y the angles about x and z are one."""
    found = group(count=3, along={"points": [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]}, rotation_deg=(30.0, 90.0, 0.0))
    wanted = from_degrees((30.0, 90.0, 0.0))
    for each in found:
        assert abs(from_degrees(each.rotation_deg) @ wanted) == pytest.approx(1.0, abs=1e-12)


def test_one_count_is_a_row_by_a_number_or_by_a_way():
    assert places(group(count=3, spacing=0.2))[:, 0] == pytest.approx([0.0, 0.2, 0.4])
    stairs = places(group(count=3, spacing=(0.2, 0.0, 0.1)))
    assert stairs == pytest.approx(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.1], [0.4, 0.0, 0.2]]))


def test_bodies_on_a_curve_are_equally_far_apart_and_face_along_it():
    points = ((0.0, 0.0, 0.0), (1.0, 0.4, 0.0), (2.0, -0.4, 0.0), (3.0, 0.0, 0.0))
    bodies = group(count=61, along={"points": points})
    found = places(bodies)
    assert found[0] == pytest.approx(points[0]) and found[-1] == pytest.approx(points[-1])
    # Chords of a curve of a radius R are shorter than its arcs s by s³/(24 R²): 0.3 % where it bends most.
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert steps == pytest.approx(steps.mean(), rel=5e-3)
    for point in points[1:-1]:
        assert np.linalg.norm(found - point, axis=1).min() < steps.mean()
    for before, here, after in zip(found[:-2], bodies[1:-1], found[2:], strict=True):
        facing = rotated(from_degrees(here.rotation_deg), np.array([1.0, 0.0, 0.0]))
        along = (after - before) / np.linalg.norm(after - before)
        assert facing @ along > 0.999


def test_a_closed_curve_has_no_two_bodies_at_its_end():
    square = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    found = places(group(count=40, along={"points": square, "closed": True, "turned": False}))
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise([*found, found[0]])]
    assert steps == pytest.approx([np.mean(steps)] * 40, rel=0.02)


@pytest.mark.parametrize(
    "room",
    [
        {"type": "box", "size": (0.6, 0.5, 0.4)},
        {"type": "sphere", "radius": 0.35},
        {"type": "cylinder", "radius": 0.3, "height": 0.5},
        {"type": "capsule", "radius": 0.25, "height": 0.4},
        {"type": "torus", "major_radius": 0.5, "minor_radius": 0.15},
    ],
    ids=lambda room: room["type"],
)
def test_scattered_bodies_are_in_their_shape_and_clear_of_each_other(room):
    scatter = {"shape": room, "gap": 0.004}
    bodies = group(position=(0.5, 0.0, 1.0), rotation_deg=(20.0, 0.0, 0.0), count=15, scatter=scatter)
    around = build_solid(Placement(shape=room, position=(0.5, 0.0, 1.0), rotation_deg=(20.0, 0.0, 0.0)))
    corners = np.concatenate([build_solid(each).surface_mesh().vertices for each in bodies])
    assert around.signed_distance(corners).max() < 1e-9
    radius = ball_around(bodies[0].shape)
    assert radius is not None
    apart = min(np.linalg.norm(a - b) for a, b in combinations(places(bodies), 2))
    assert apart >= 2.0 * radius + 0.004 - 3e-9  # places are rounded to a nanometre
    assert len({each.rotation_deg for each in bodies}) == 15


def test_the_same_table_gives_the_same_bodies_on_every_machine():
    """What was found once, to the last digit: a generator or a formula that changes would change everybody's films."""
    keys = {"count": 25, "scatter": BOX, "scales": (0.5, 1.2), "jitter": {"position": (0.001, 0.001, 0.0)}}
    bodies = group(**keys)
    text = json.dumps([(each.position, each.rotation_deg, each.scale) for each in bodies])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == KEPT, (bodies[0].position, bodies[0].rotation_deg)
    assert group(**keys) == bodies
    assert places(group(**keys, seed=1)).tolist() != places(bodies).tolist()
    assert places(group(**keys, name="other")).tolist() != places(bodies).tolist()


KEPT = "a57d197b04b28fef"


def test_jitter_turns_and_moves_bodies_within_its_reach_and_changes_no_other_chance():
    straight = group(count=(10, 10, 1), spacing=0.2)
    out_of_line = group(
        count=(10, 10, 1), spacing=0.2, jitter={"position": (0.01, 0.0, 0.0), "rotation_deg": (0, 0, 5)}
    )
    moved = places(out_of_line) - places(straight)
    assert np.all(moved[:, 1:] == 0.0) and 0.008 < np.abs(moved[:, 0]).max() <= 0.01
    turns = np.array([each.rotation_deg for each in out_of_line])
    assert np.abs(turns[:, :2]).max() < 1e-5 and 4.0 < np.abs(turns[:, 2]).max() <= 5.0
    scattered = group(count=30, scatter={**BOX, "turned": False})
    turned = group(count=30, scatter=BOX)
    assert [each.position for each in scattered] == [each.position for each in turned]
    assert {each.rotation_deg for each in scattered} == {(0.0, 0.0, 0.0)}


def test_random_turns_favour_no_direction():
    bodies = group(cube(0.01), count=2000, scatter={"shape": {"type": "box", "size": (2.0, 2.0, 2.0)}})
    up = np.stack([rotated(from_degrees(each.rotation_deg), np.array([0.0, 0.0, 1.0])) for each in bodies])
    # Of uniform directions the mean is 0 and each square 1/3; errors of 4 standard deviations.
    assert np.abs(up.mean(axis=0)).max() < 4.0 * np.sqrt(1.0 / 3.0 / 2000)
    assert np.square(up).mean(axis=0) == pytest.approx([1.0 / 3.0] * 3, abs=4.0 * np.sqrt(4.0 / 45.0 / 2000))


def test_sizes_are_eight_between_two_and_those_of_one_share_a_model():
    bodies = group(count=200, scatter={"shape": {"type": "box", "size": (3.0, 3.0, 3.0)}}, scale=2.0, scales=(0.5, 1.5))
    sizes = sorted({each.scale for each in bodies})
    assert len(sizes) == SIZES and sizes[0] == 1.0 and sizes[-1] == 3.0
    models = {each.scale: each.model for each in bodies}
    assert all(each.model == models[each.scale] for each in bodies)
    assert len({each.model for each in bodies}) == SIZES


def test_a_second_scattered_group_keeps_clear_of_the_first():
    tables = [body(name, ball(0.03), (0, 0, 0), count=40, scatter=BOX) for name in ("one", "two")]
    found = places(with_groups(tuple(tables)))
    assert min(np.linalg.norm(a - b) for a, b in combinations(found, 2)) >= 0.06 - 3e-9


def test_a_shape_that_is_full_is_refused_with_how_many_have_room():
    with pytest.raises(
        KeyRefusedError, match=r"has room for (\d+) of 500 bodies: each takes a ball of up to 0.1"
    ) as told:
        group(ball(0.05), count=500, scatter=BOX)
    fitted = int(str(told.value).split("room for ")[1].split()[0])
    # Random sequential addition saturates at a volume fraction of 0.38; walls cost some.
    full = 0.38 * (0.6 * 0.5 * 0.4) / (4.0 / 3.0 * np.pi * 0.05**3)
    assert 0.5 * full < fitted < full
    assert len(group(ball(0.05), count=fitted, scatter=BOX)) == fitted


@pytest.mark.parametrize(
    ("keys", "path", "message"),
    [
        ({"spacing": 0.1}, "spacing", "no meaning for one body; add count"),
        ({"count": 5}, "count", "nothing places the bodies; give one of spacing, along, scatter"),
        ({"count": 5, "spacing": 0.1, "scatter": BOX}, "count", "spacing and scatter place the bodies"),
        ({"count": (2, 2, 2), "scatter": BOX}, "count", "lattice needs spacing"),
        ({"count": 5, "spacing": 0.1, "offset": (0.1, 0, 0)}, "offset", "shifts storeys of a lattice"),
        ({"count": (100, 100, 100), "spacing": 0.1}, "count", "1,000,000 bodies; a group has 100,000 at most"),
        ({"count": 3, "spacing": 0.1, "scales": (2.0, 1.0)}, "scales", "smallest size first"),
    ],
)
def test_a_table_that_contradicts_itself_is_refused_at_its_key(keys, path, message):
    with pytest.raises(ValidationError, match=message) as told:
        body("brick", BRICK, **keys)
    assert told.value.errors()[0]["ctx"]["error"].path == (path,)


def test_keyframes_would_lead_all_bodies_to_one_place():
    path = [{"time_s": 0.0, "position": (0, 0, 0)}, {"time_s": 1.0, "position": (1, 0, 0)}]
    with pytest.raises(ValidationError, match="lead all bodies of a group through one place"):
        body("door", BRICK, kind="kinematic", keyframe=path, count=3, spacing=0.2)


def test_what_has_no_names_or_sizes_is_refused():
    with pytest.raises(KeyRefusedError, match="too long for bodies named up to"):
        group(name="b" * 62, count=10, spacing=0.2)
    mesh = {"type": "mesh", "file": "stone.obj"}
    with pytest.raises(KeyRefusedError, match="longest edge of its mesh"):
        group(mesh, count=10, scatter=BOX)
    assert len(group({**mesh, "size": 0.05}, count=10, scatter=BOX)) == 10


def test_a_scene_has_the_bodies_and_what_decides_its_frames_nothing_of_how_they_were_made():
    table = {"name": "brick", "shape": BRICK, "count": 3, "spacing": 0.25}
    one_by_one = [
        {"name": f"brick_{number}", "shape": BRICK, "position": (0.25 * number - 0.25, 0.0, 0.0)}
        for number in (1, 2, 3)
    ]
    scene = SceneParameters.model_validate({"rigid": (table, {"name": "ball", "shape": ball(0.1)})})
    assert [(each.name, each.table) for each in scene.rigid] == [
        ("brick_1", 0),
        ("brick_2", 0),
        ("brick_3", 0),
        ("ball", 1),
    ]
    same = SceneParameters.model_validate({"rigid": one_by_one})
    assert [each.model_dump() for each in scene.rigid[:3]] == [each.model_dump() for each in same.rigid]


@pytest.mark.parametrize(
    "shape",
    [
        BRICK,
        ball(0.1),
        {"type": "cylinder", "radius": 0.1, "height": 0.3},
        {"type": "capsule", "radius": 0.1, "height": 0.3},
        {"type": "torus", "major_radius": 0.2, "minor_radius": 0.05},
        {"type": "cone", "radius": 0.1, "height": 0.3},
        {"type": "revolved", "profile": ((0.0, 0.1), (0.2, 0.1), (0.2, 0.6), (0.0, 0.6))},
        {"type": "duck", "length": 0.3},
        {"type": "bunny", "height": 0.3},
    ],
    ids=lambda shape: shape["type"],
)
def test_the_ball_around_a_shape_holds_its_mesh_and_little_more(shape):
    placement = Placement(shape=shape)
    reach = np.linalg.norm(build_solid(placement).surface_mesh().vertices, axis=1).max()
    radius = ball_around(placement.shape)
    assert radius is not None
    assert reach <= radius * (1.0 + 1e-9) and radius < 1.4 * reach


def test_depths_inside_of_rooms_are_those_of_the_solids():
    rooms = [
        {"type": "box", "size": (0.6, 0.5, 0.4)},
        {"type": "sphere", "radius": 0.35},
        {"type": "cylinder", "radius": 0.3, "height": 0.5},
        {"type": "capsule", "radius": 0.25, "height": 0.4},
        {"type": "torus", "major_radius": 0.5, "minor_radius": 0.15},
    ]
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3))
    for room in rooms:
        placement = Placement(shape=room)
        solid = build_solid(placement)
        inside = solid.signed_distance(points) < 0.0
        depths = np.array([depth_inside(placement.shape, point) for point in points[inside]])
        assert depths == pytest.approx(-solid.signed_distance(points[inside]), abs=1e-12)
        assert box_around(placement.shape) == pytest.approx(solid.bounds[1], rel=1e-9)
