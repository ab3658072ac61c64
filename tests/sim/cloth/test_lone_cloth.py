"""Cloth that meets no cloth: patches are bounded, and it moves as if its pairs had been looked for in vain."""

import numpy as np
import pytest
from cloth_scenes import cloth, rectangle, solver_of
from contact_scenes import ROOM, cloth_of, contacts_of, rigid_of, world_of

from sim.cloth.lone_cloth import LoneCloth
from sim.cloth.patches import Patches
from validation.crossing_triangles import crossings

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SHEET = {"shape": rectangle((0.2, 0.2), (15, 15)), "thickness": 3e-3, "self_collision": False}
BALL = {"kind": "kinematic", "shape": {"type": "sphere", "radius": 0.05}, "position": (0.0, 0.0, 0.1)}


def test_spheres_around_patches_and_their_displacements_hold_all_corners():
    state = solver_of(cloth("sheet", shape=rectangle((0.3, 0.3), (13, 13)))).state
    generator = np.random.default_rng(0)
    x = state.host.position + generator.normal(0.0, 0.01, (169, 3))
    u = generator.normal(0.0, 0.02, (169, 3))
    state.set_positions(x)
    state.displacement.from_numpy(u.astype(np.float32))
    patches = Patches(state.host)
    lone = LoneCloth(state, patches)
    lone.look(state)
    assert lone.looked()[0] >= np.linalg.norm(u, axis=1).max() * (1.0 - 1e-6)
    centre, shift, turn, radius, rest = (array.to_numpy() for array in lone.motion)
    assert not turn.any()
    first = patches.first_corner.to_numpy()
    for m, corners in enumerate(np.split(patches.corners.to_numpy(), first[1:-1])):
        # A few roundings of float32.
        assert np.linalg.norm(x[corners] - centre[m], axis=1).max() <= radius[m] * (1.0 + 1e-6)
        assert np.linalg.norm(u[corners] - shift[m], axis=1).max() <= rest[m] * (1.0 + 1e-6)


def test_a_lone_cloth_moves_as_if_its_pairs_had_been_looked_for():
    """Bodies push it at once by far more than its thickness, on the floor and off it."""
    box = {**BALL, "shape": {"type": "box", "size": (0.06, 0.06, 0.06)}, "position": (0.07, 0.07, 0.12)}
    sheet = {**SHEET, "position": (0.0, 0.0, 0.02), "iterations": 1}  # a second look may have springs take more turns
    worlds = [world_of(sheet, bodies=[BALL, box], domain=ROOM) for _ in range(2)]
    contacts = contacts_of(cloth_of(worlds[1]))
    contacts._lone = contacts._pairs
    for world in worlds:
        for frame in range(10):
            height = 0.02 if frame % 4 < 2 else 0.15
            rigid_of(world).lead("body0", (0.02 * frame, 0.0, height), within_s=1.0 / 60.0)
            world.advance_frame()
    assert contacts_of(cloth_of(worlds[0])).diagnostics()["contacts"] > 0.0
    for name, array in worlds[0].checkpoint().items():
        np.testing.assert_array_equal(worlds[1].checkpoint()[name], array, err_msg=name)


def test_cloth_that_begins_to_collide_with_itself_between_frames_does_not_cross_itself_from_then_on():
    fall = {"shape": rectangle((0.2, 0.3), (11, 16)), "thickness": 3e-3, "rotation_deg": (85.0, 5.0, 0.0)}
    switched, never = (world_of({**fall, "position": (0.0, 0.0, 0.17)}) for _ in range(2))
    cloth_of(never).change("cloth0", self_collision=False)
    for frame in range(24):
        if frame in (0, 2, 3, 5):  # its layers meet later
            cloth_of(switched).change("cloth0", self_collision=frame in (2, 5))
        switched.advance_frame()
        never.advance_frame()
    count, count_of_never = (
        len(crossings(cloth_of(world).state.positions(), cloth_of(world).state.host.triangles))
        for world in (switched, never)
    )
    assert count == 0 < count_of_never


def test_cloth_that_collides_with_itself_again_moves_as_a_fresh_scene_that_continues_there():
    """What was listed before it stopped colliding is not what is near it now: it has folded meanwhile."""
    fall = {"shape": rectangle((0.2, 0.3), (11, 16)), "thickness": 3e-3, "rotation_deg": (85.0, 5.0, 0.0)}
    switched = world_of({**fall, "position": (0.0, 0.0, 0.17)})
    for frame in range(15):
        if frame in (6, 12):
            cloth_of(switched).change("cloth0", self_collision=frame == 12)
        if frame == 12:
            fresh = world_of({**fall, "position": (0.0, 0.0, 0.17)})
            fresh.restore(12, {name: array.copy() for name, array in switched.checkpoint().items()})
        switched.advance_frame()
        if frame >= 12:
            fresh.advance_frame()
            for name, array in switched.checkpoint().items():
                np.testing.assert_array_equal(fresh.checkpoint()[name], array, err_msg=f"{name}, frame {frame}")


@pytest.mark.parametrize("self_collision", [True, False])
def test_a_run_in_the_middle_of_a_push_continues_bit_for_bit(self_collision):
    """Every frame begins with the margins of a run's start.

    The ball gets faster where the run is restored, and pushes in a substep by more than these allow, but by no more
    than margins kept from the frame before would.
    """
    sheet = {**SHEET, "self_collision": self_collision, "position": (0.0, 0.0, 0.2)}
    through, resumed = (world_of(sheet, bodies=[BALL], domain=ROOM) for _ in range(2))

    def push(world, frame):
        height = 0.1 + 0.032 * min(frame, 2) + 0.036 * max(frame - 2, 0)
        rigid_of(world).lead("body0", (0.0, 0.0, height), within_s=1.0 / 60.0)
        world.advance_frame()

    for frame in (1, 2):
        push(through, frame)
    saved = {name: array.copy() for name, array in through.checkpoint().items()}
    rigid_of(resumed).paths.update(rigid_of(through).paths)
    resumed.restore(2, saved)
    for frame in (3, 4, 5):
        for world in (through, resumed):
            push(world, frame)
        for name, array in through.checkpoint().items():
            np.testing.assert_array_equal(resumed.checkpoint()[name], array, err_msg=f"{name}, frame {frame}")
