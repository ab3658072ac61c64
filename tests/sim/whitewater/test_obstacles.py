"""Whitewater stays out of walls and bodies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from whitewater_scenes import BOX, FPS, NO_FLUID, RADIUS, cloud, solver

from sim.core.domain import DomainParameters
from sim.shapes.level_set import LevelSet
from sim.shapes.parameters import Placement
from sim.whitewater.obstacles import MovingObstacle, Obstacles, Pose, sample_at_rest

DT = 1.0 / FPS
CLOSED = DomainParameters(min=BOX.min, max=BOX.max, open_faces=())


def placed(shape: dict, radius: float = RADIUS) -> LevelSet:
    return sample_at_rest(Placement.model_validate({"shape": shape}), radius)


def pose(position=(0.0, 0.0, 0.5), turn_deg: float = 0.0) -> Pose:
    orientation = Rotation.from_euler("y", turn_deg, degrees=True).as_quat(scalar_first=True)
    return Pose(np.asarray(position, float), orientation)


def standing(level_set: LevelSet, at: Pose) -> MovingObstacle:
    return MovingObstacle(level_set, at, at)


def shower(count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return random.uniform(BOX.min, BOX.max, (count, 3)), random.normal(0, 5, (count, 3))


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "sphere", "radius": 0.2},
        {"type": "box", "size": [0.3, 0.2, 0.4]},
        {"type": "torus", "major_radius": 0.2, "minor_radius": 0.08},
        {"type": "duck", "length": 0.4},
    ],
    ids=lambda shape: shape["type"],
)
def test_nobody_is_left_inside_a_turned_body(shape):
    level_set = placed(shape)
    body = standing(level_set, pose(turn_deg=30.0))
    position, velocity = shower()
    moved, _, touched, stays = Obstacles(CLOSED, [body], DT).collide(position, velocity, 1.0)
    distance = level_set.signed_distance(body.end.at_rest(moved))
    started_inside = level_set.signed_distance(body.end.at_rest(position)) < 0.0
    assert started_inside.sum() > 50
    assert (distance[stays] >= 0.0).all()
    np.testing.assert_array_equal(touched, started_inside)
    # Almost all find their way out; a few of the deepest may be where no way is the shortest.
    assert stays.mean() > 0.98


def test_what_hits_a_ball_slides_off():
    ball = standing(placed({"type": "sphere", "radius": 0.2}), pose())
    position = np.array([[0.0, 0.0, 0.695], [0.0, 0.0, 0.695]])
    velocity = np.array([[1.0, 0.0, -3.0], [1.0, 0.0, 2.0]])
    moved, after, touched, _ = Obstacles(CLOSED, [ball], DT).collide(position, velocity, 1.0)
    assert touched.all()
    # At the pole of a ball sampled at a spacing of r: the distance is good to spacing²/(4 R) = 1e-4 m, and the points
    # are put 1 % of a spacing off the surface.
    np.testing.assert_allclose(moved[:, 2], 0.7, atol=2.5e-4)
    np.testing.assert_allclose(after, [[1.0, 0.0, 0.0], [1.0, 0.0, 2.0]], atol=1e-6)


def test_a_moving_body_takes_along_what_it_meets():
    ball = MovingObstacle(placed({"type": "sphere", "radius": 0.2}), pose((0, 0, 0.5)), pose((0.02, 0, 0.5)))
    ahead = np.array([[0.215, 0.0, 0.5]])
    moved, velocity, touched, _ = Obstacles(CLOSED, [ball], DT).collide(ahead, np.zeros((1, 3)), 1.0)
    assert touched.all()
    np.testing.assert_allclose(moved[0, 0], 0.22, atol=2.5e-4)
    np.testing.assert_allclose(velocity[0], [0.02 / DT, 0.0, 0.0], atol=1e-3 * 0.02 / DT)


def test_a_body_is_where_it_is_in_the_middle_of_a_frame():
    obstacle = MovingObstacle(placed({"type": "sphere", "radius": 0.2}), pose((0, 0, 0.5)), pose((0.2, 0, 0.6), 90.0))
    middle = obstacle.pose(0.5)
    np.testing.assert_allclose(middle.position, [0.1, 0.0, 0.55])
    np.testing.assert_allclose(middle.rotation.as_matrix(), pose(turn_deg=45.0).rotation.as_matrix(), atol=1e-12)


def test_closed_walls_hold_and_open_ones_let_go(taichi_cpu):
    rain = cloud(np.tile([0.0, 0.0, 0.5], (6, 1)), np.concatenate([np.eye(3), -np.eye(3)]) * 60.0)
    after, _ = solver(gravity=(0.0, 0.0, 0.0)).advance_frame(rain, NO_FLUID, NO_FLUID, frame=1, particle_radius=RADIUS)
    # z+ is open: five of six are stopped at walls, none is beyond by so much as a rounding.
    assert len(after) == 5
    assert (after.position >= np.float32(BOX.min)).all()
    assert (after.position <= np.float32(BOX.max)).all()
    assert np.abs(after.velocity).max() == 0.0


def test_what_is_beyond_a_closed_face_is_mirrored_in_it(taichi_cpu):
    low, high = np.array(BOX.min), np.array(BOX.max)
    open_top = Obstacles(DomainParameters(min=BOX.min, max=BOX.max, open_faces=("z+",)), [], DT)
    middle = 0.5 * (low + high)
    points = np.stack([middle, middle, middle, middle])
    points[1, 0], points[2, 1], points[3, 2] = low[0] - 0.02, high[1] + 0.03, high[2] + 0.01
    velocity = np.tile([1.0, 2.0, 3.0], (4, 1))
    position, moving = open_top.mirrored(points, velocity)
    expected = points.copy()
    expected[1, 0], expected[2, 1] = low[0] + 0.02, high[1] - 0.03
    np.testing.assert_allclose(position, expected, atol=1e-6)
    np.testing.assert_array_equal(moving, [[1, 2, 3], [-1, 2, 3], [1, -2, 3], [1, 2, 3]])


def test_what_is_caught_between_a_body_and_the_floor_is_gone():
    block = standing(placed({"type": "box", "size": [0.4, 0.4, 0.4]}), pose((0.0, 0.0, 0.15)))
    position = np.array([[0.0, 0.0, 0.001], [0.0, 0.0, 0.5]])
    _, _, _, stays = Obstacles(CLOSED, [block], DT).collide(position, np.zeros((2, 3)), 1.0)
    assert stays.tolist() == [False, True]


def test_planes_cut_their_share_off_a_ball():
    """A wall at half the radius cuts off 5/32; in the corner of three walls an eighth is free."""
    obstacles = Obstacles(CLOSED, [], DT)
    points = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.02], [-0.5, -0.5, 0.0]])
    np.testing.assert_allclose(obstacles.free_share(points, 0.04, 1.0), [1, 0.5, 1 - 5 / 32, 1 / 8], atol=1e-6)


def test_a_body_counts_as_a_wall_close_by():
    slab = standing(placed({"type": "box", "size": [0.4, 0.4, 0.1]}), pose((0.0, 0.0, 0.5)))
    free = Obstacles(CLOSED, [slab], DT).free_share(np.array([[0.0, 0.0, 0.57], [0.0, 0.0, 0.7]]), 0.04, 1.0)
    # Above a flat face interpolation is exact to the single precision of the grid.
    np.testing.assert_allclose(free, [1 - 5 / 32, 1.0], atol=1e-5)
