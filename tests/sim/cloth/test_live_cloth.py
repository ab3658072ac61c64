"""A world that somebody plays with: what may change between frames does, and the cloth goes on without a jump."""

import math

import numpy as np
import pytest
from cloth_scenes import FRAMES_PER_SECOND, rectangle
from contact_scenes import SPACE, cloth_of, rigid_of, world_of

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SHEET = {"shape": rectangle((0.3, 0.3), (13, 13)), "thickness": 2e-3}
CORNER, OTHER_CORNER = 0, 12


def positions(world) -> np.ndarray:
    return world.snapshots()["cloth0"].arrays["position"].astype(np.float64)


def test_a_hand_holds_leads_and_throws_a_corner():
    world = world_of({**SHEET, "pin": ({"corner": "x+y-"},)}, domain=SPACE)
    solver = cloth_of(world)
    start = positions(world)
    solver.hold("cloth0", [CORNER])
    world.advance_frame()
    np.testing.assert_array_equal(positions(world)[[CORNER, OTHER_CORNER]], start[[CORNER, OTHER_CORNER]])
    for _ in range(2):  # led on from where it is
        solver.hold("cloth0", [CORNER], shift=(0.0, 0.0, 0.01))
        world.advance_frame()
    # Float32, from 20 steps a frame of which each rounds to the quantum of positions.
    np.testing.assert_allclose(positions(world)[CORNER], start[CORNER] + [0.0, 0.0, 0.02], atol=1e-6)
    velocity = world.snapshots()["cloth0"].arrays["velocity"][CORNER]
    np.testing.assert_allclose(velocity, [0.0, 0.0, 0.01 * FRAMES_PER_SECOND], rtol=1e-3, atol=1e-5)
    solver.let_go("cloth0", [CORNER])
    world.advance_frame()
    assert positions(world)[CORNER, 2] > start[CORNER, 2] + 0.021  # it flies on
    for _ in range(12):
        world.advance_frame()
    assert positions(world)[CORNER, 2] < start[CORNER, 2]
    np.testing.assert_array_equal(positions(world)[OTHER_CORNER], start[OTHER_CORNER])


def test_pins_of_the_job_can_be_let_go_node_by_node():
    world = world_of({**SHEET, "pin": ({"edge": "y-"},)}, domain=SPACE)
    start = positions(world)
    cloth_of(world).let_go("cloth0", range(6))
    for _ in range(5):
        world.advance_frame()
    after = positions(world)
    np.testing.assert_array_equal(after[6:13], start[6:13])
    assert (after[:4, 2] < start[:4, 2]).all()


def test_a_hand_takes_nodes_off_the_path_of_a_pin_and_leaves_it_the_others():
    path = [{"time_s": 0.0}, {"time_s": 1.0, "offset": (0.0, 0.0, 0.1)}]
    pin = {"index": (CORNER, OTHER_CORNER), "keyframe": path, "interpolation": "linear"}
    world = world_of({**SHEET, "pin": (pin,)}, domain=SPACE)
    solver = cloth_of(world)
    start = positions(world)
    world.advance_frame()
    held = positions(world)[CORNER]
    assert held[2] > start[CORNER, 2] + 0.5e-3  # it was on the path
    for way in (0.0, 0.01, 0.0):
        solver.hold("cloth0", [CORNER], shift=(way, 0.0, 0.0))
        world.advance_frame()
    # Float32, from 20 steps a frame of which each rounds to the quantum of positions.
    np.testing.assert_allclose(positions(world)[CORNER], held + np.array([0.01, 0.0, 0.0]), atol=1e-6)
    followed = [0.0, 0.0, 0.1 * 4 / FRAMES_PER_SECOND]
    np.testing.assert_allclose(positions(world)[OTHER_CORNER], start[OTHER_CORNER] + followed, atol=1e-6)


@pytest.mark.parametrize(
    ("way", "within_s"), [(0.1, 0.0), (0.1, -1.0), (0.1, math.nan), (math.nan, 1.0), (math.inf, 1.0), (0.0, 0.0)]
)
def test_ways_without_an_end_or_a_time_are_refused(way, within_s):
    ball = {"kind": "kinematic", "shape": {"type": "sphere", "radius": 0.08}, "position": (0.0, 0.0, -0.5)}
    world = world_of(SHEET, bodies=[ball], domain=SPACE)
    with pytest.raises(ValueError, match="a finite way in more than 0 s is needed, got"):
        cloth_of(world).hold("cloth0", [CORNER], shift=(0.0, way, 0.0), within_s=within_s)
    with pytest.raises(ValueError, match="a finite pose in more than 0 s is needed, got"):
        rigid_of(world).lead("body0", (0.0, way, 0.0), within_s=within_s)
    if way:
        with pytest.raises(ValueError, match=r"a finite pose in more than 0 s is needed, got .* degrees within"):
            rigid_of(world).lead("body0", (0.0, 0.0, 0.0), rotation_deg=(0.0, way, 0.0), within_s=within_s)


def test_a_ball_that_is_led_about_pushes_the_cloth_and_stiffness_and_wind_change_on_the_way():
    ball = {"kind": "kinematic", "shape": {"type": "sphere", "radius": 0.08}, "position": (0.0, 0.0, -0.12)}
    pins = tuple({"corner": corner} for corner in ("x-y-", "x+y-", "x-y+", "x+y+"))
    world = world_of({**SHEET, "air_density": 1.2, "pin": pins}, bodies=[ball], domain=SPACE)
    solver, rigid = cloth_of(world), rigid_of(world)
    deepest = 0.0
    for frame in range(16):
        if frame % 4 == 0:
            target = (0.02, 0.01 * frame, -0.12 + 0.02 * frame)
            rigid.lead("body0", target, within_s=4 / FRAMES_PER_SECOND)
            solver.change("cloth0", stretch_stiffness=500.0 * (1 + frame), wind=(0.2 * frame, 0.0, 0.0))
        world.advance_frame()
        centre = world.snapshots()["body0"].arrays["position"]
        deepest = max(deepest, 0.08 - float(np.linalg.norm(positions(world) - centre, axis=1).min()))
    np.testing.assert_allclose(centre, [0.02, 0.12, 0.12], atol=1e-12)
    # Vertices of the cloth stay half a thickness outside; 24 iterations leave a share of what a substep moves, 1.3 mm.
    assert deepest < 1.0e-3
    assert positions(world)[:, 2].max() > 0.15  # it was lifted


def test_what_cannot_be_held_or_led_is_refused_by_name():
    body = {"shape": {"type": "sphere", "radius": 0.05}, "position": (0.0, 0.0, -0.5)}
    world = world_of(SHEET, bodies=[{**body, "kind": "dynamic", "density": 600.0}], domain=SPACE)
    solver = cloth_of(world)
    with pytest.raises(ValueError, match='no cloth is named "sheet"; cloths are cloth0'):
        solver.hold("sheet", [0])
    with pytest.raises(ValueError, match=r'nodes of cloth "cloth0" are 0 to 168, got \[169\]'):
        solver.let_go("cloth0", [169])
    with pytest.raises(ValueError, match='no kinematic body is named "body0"'):
        rigid_of(world).lead("body0", (0.0, 0.0, 0.0), within_s=1.0)
