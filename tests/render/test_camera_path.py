"""Where the camera of a job is at any time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from pydantic import ValidationError

from render.camera_path import HORIZON, MARGIN, CameraPath, View, write_views
from render.parameters import CameraParameters
from render.spec import Camera
from render.visibility import screen_positions

LOW, HIGH = (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)
MIDDLE = (0.0, 0.0, 0.5)
START = {"duck": (0.1, 0.2, 0.3)}


def path_of(**camera: object) -> CameraPath:
    return CameraPath(CameraParameters.model_validate(camera), LOW, HIGH, aspect=16 / 9, starts=START)


def position(path: CameraPath, time_s: float) -> np.ndarray:
    return np.array(path.view(time_s, START).position)


@pytest.mark.parametrize("aspect", [16 / 9, 1.0, 9 / 16])
@pytest.mark.parametrize(
    ("low", "high"), [((-0.5, -0.5, 0), (0.5, 0.5, 1)), ((0, 0, 0), (4, 0.3, 0.2)), ((10, 10, -3), (10.1, 10.2, 5))]
)
def test_automatic_camera_shows_the_whole_domain_and_no_more_than_needed(low, high, aspect):
    view = CameraPath(CameraParameters(), low, high, aspect=aspect, starts={}).first()
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=float)
    screen = screen_positions(view, corners, aspect=aspect)  # NaN for what lies behind the camera
    assert (abs(screen) <= 1 - 2 * MARGIN + 1e-9).all()
    # The axis that decides the distance is filled on both sides, the other one is not.
    filled = np.minimum(screen.max(axis=0), -screen.min(axis=0)).max()
    assert filled == pytest.approx(1 - 2 * MARGIN, abs=1e-9)
    assert view.look_at[2] < view.position[2]


@pytest.mark.parametrize("focal_length_mm", [24.0, 50.0, 135.0])
@pytest.mark.parametrize("aspect", [16 / 9, 1.0, 9 / 16])
@pytest.mark.parametrize("size", [(1.0, 1.0, 6.0), (6.0, 6.0, 0.3), (4.0, 0.3, 0.2), (0.8, 0.8, 1.2)])
def test_automatic_camera_shows_a_horizon_from_above_the_ground(size, aspect, focal_length_mm):
    high = (*size[:2], size[2] - 3.0)
    camera = CameraParameters(focal_length_mm=focal_length_mm)
    view = CameraPath(camera, (0.0, 0.0, -3.0), high, aspect=aspect, starts={}).first()
    assert view.position[2] > -3.0
    # A point of the view's heading, so far away that it lies at the horizon.
    heading = np.subtract(view.look_at, view.position) * (1.0, 1.0, 0.0)
    far = np.array(view.position) + 1e6 * heading / np.linalg.norm(heading)
    (across, up), *_ = screen_positions(view, far[None], aspect=aspect)
    assert abs(across) < 1e-6
    assert 0.0 < up <= HORIZON + 1e-6


def test_automatic_camera_rises_where_the_picture_has_room():
    """A pool is seen from above its rim, a tower from as low as the horizon asks for."""
    pool, tower = (
        CameraPath(CameraParameters(), low, high, aspect=16 / 9, starts={}).first()
        for low, high in (((-2, -2, 0), (2, 2, 0.4)), ((-0.2, -0.2, 0), (0.2, 0.2, 4)))
    )

    def elevation(view: View, middle: tuple[float, float, float]) -> float:
        across, up = np.linalg.norm(np.subtract(view.position, middle)[:2]), view.position[2] - middle[2]
        return math.degrees(math.atan2(up, across))

    assert 11.0 < elevation(pool, (0.0, 0.0, 0.2)) <= 17.0
    assert 8.0 < elevation(tower, (0.0, 0.0, 2.0)) < 10.0


def test_a_still_camera_does_not_move_and_looks_at_the_middle():
    path = path_of(position=(0.0, -2.5, 0.5), f_stop=2.8)
    assert not path.moves
    assert path.view(7.0, {}) == path.first()
    assert path.first().look_at == MIDDLE
    assert path.first().focus_distance == pytest.approx(2.5)
    assert path.distance_all_round() is None


KEYS = [
    {"time_s": 1.0, "position": (0.0, -2.0, 0.5)},
    {"time_s": 2.0, "position": (1.0, -2.0, 0.5), "look_at": (0.5, 0.0, 0.5), "focal_length_mm": 85.0},
    {"time_s": 4.0, "position": (1.0, -1.0, 0.5)},
]


@pytest.mark.parametrize("easing", ["smooth", "linear"])
def test_keyframes_are_reached_at_their_times_and_held_beyond_them(easing):
    path = path_of(keyframe=KEYS, easing=easing)
    assert path.moves
    for key in KEYS:
        view = path.view(key["time_s"], {})
        assert view.position == pytest.approx(key["position"])
        assert view.look_at == pytest.approx(key.get("look_at", MIDDLE))
        assert view.focal_length_mm == pytest.approx(key.get("focal_length_mm", 50.0))
    assert path.view(0.0, {}) == path.view(1.0, {})
    assert path.view(9.0, {}) == path.view(4.0, {})
    assert path.longest_focal_length() == 85.0


def test_a_smooth_way_starts_and_stops_gently_without_a_jump_of_speed_or_overshoot():
    path, step = path_of(keyframe=KEYS), 1e-4
    times = np.arange(1.0, 4.0, step)
    places = np.array([position(path, time) for time in times])
    speeds = np.diff(places, axis=0) / step
    assert np.abs(speeds[[0, -1]]).max() < 1e-2  # of 1 m/s on average
    assert np.abs(np.diff(speeds, axis=0)).max() < 1e-2
    assert places[:, 0].max() <= 1.0 + 1e-9


def test_a_linear_way_has_constant_speed():
    path = path_of(keyframe=KEYS, easing="linear")
    np.testing.assert_allclose(position(path, 1.25), (0.25, -2.0, 0.5), atol=1e-12)
    np.testing.assert_allclose(position(path, 2.5), (1.0, -1.75, 0.5), atol=1e-12)


def test_an_orbit_keeps_height_and_distance_and_goes_counter_clockwise():
    path = path_of(position=(0.0, -2.5, 0.9), orbit_deg_per_s=45.0)
    np.testing.assert_allclose(position(path, 2.0), (2.5, 0.0, 0.9), atol=1e-12)
    np.testing.assert_allclose(position(path, 4.0), (0.0, 2.5, 0.9), atol=1e-12)
    assert path.view(2.0, {}).look_at == MIDDLE
    assert path.distance_all_round() == pytest.approx(2.5)


def test_an_orbit_from_straight_above_stays_there():
    path = path_of(position=(0.0, 0.0, 3.0), look_at=(0.0, 0.0, 0.0), orbit_deg_per_s=30.0)
    np.testing.assert_allclose(position(path, 2.0), (0.0, 0.0, 3.0), atol=1e-12)
    camera = Camera.on(path, f_stop=None, views="views/{frame}.json")
    assert camera.distance_all_round == 0.0


def test_a_camera_that_follows_keeps_its_place_beside_the_body():
    path = path_of(position=(0.0, -2.5, 0.5), follow="duck")
    assert path.bodies == ("duck",)
    assert path.first().position == pytest.approx((0.0, -2.5, 0.5))
    view = path.view(1.0, {"duck": (1.1, 0.2, 0.8)})
    assert view.position == pytest.approx((1.0, -2.5, 1.0))
    assert view.look_at == pytest.approx((1.0, 0.0, 1.0))


def test_a_camera_that_looks_at_a_body_turns_and_the_focus_is_measured_along_the_view():
    path = path_of(position=(0.0, -2.0, 0.0), look_at="duck", f_stop=2.8)
    view = path.view(1.0, {"duck": (0.0, 1.0, 4.0)})
    assert view.look_at == (0.0, 1.0, 4.0)
    assert view.focus_distance == pytest.approx(5.0)
    focused = path_of(position=(0.0, -2.0, 0.0), look_at=(0.0, 0.0, 0.0), focus="duck", f_stop=2.8)
    assert focused.view(1.0, {"duck": (0.7, 1.0, 0.3)}).focus_distance == pytest.approx(3.0)


def test_only_a_way_that_goes_far_around_sees_behind_its_first_place():
    near = [{"time_s": t, "position": (math.sin(a), -math.cos(a), 0.5)} for t, a in ((0.0, 0.0), (1.0, 0.7))]
    far = [*near, {"time_s": 2.0, "position": (2 * math.sin(1.6), -2 * math.cos(1.6), 0.5)}]
    assert path_of(keyframe=near).distance_all_round() is None
    assert path_of(keyframe=far).distance_all_round() == pytest.approx(2.0, rel=1e-6)
    quick = [
        {"time_s": 0.3 * k, "position": (math.sin(a), -math.cos(a), 0.5)} for k, a in enumerate((0.0, 1.6, 3.2, 4.8))
    ]
    rest = {"time_s": 200.0, "position": quick[0]["position"]}
    assert path_of(keyframe=[*quick, rest]).distance_all_round() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    ("camera", "complaint"),
    [
        ({"keyframe": KEYS, "orbit_deg_per_s": 10.0}, "orbit_deg_per_s has no meaning beside keyframes"),
        ({"keyframe": KEYS, "position": (0, 0, 0)}, "position has no meaning beside keyframes"),
        ({"keyframe": [KEYS[1], KEYS[0]]}, r"keyframe\[1\]\.time_s must be after 2 s"),
        ({"easing": "linear"}, "easing has no meaning without keyframes"),
        ({"keyframe": KEYS, "look_at": "duck"}, "look_at of a keyframe has no meaning beside a body"),
        ({"focus": "duck"}, "focus has no effect without f_stop"),
    ],
)
def test_motions_that_contradict_each_other_are_refused(camera, complaint):
    with pytest.raises(ValidationError, match=complaint):
        CameraParameters.model_validate(camera)


def test_views_that_are_not_finite_are_not_written(tmp_path):
    path = path_of(position=(0.0, -2.5, 0.5), follow="duck")
    with pytest.raises(ValueError, match="JSON compliant"):
        write_views(tmp_path / "0.json", 0, {0.0: path.view(0.0, {"duck": (math.nan, 0.0, 0.0)})})
