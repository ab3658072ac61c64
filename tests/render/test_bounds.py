"""Boxes around what moves, and the camera that frames them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from render.bounds import (
    around,
    box_of_particles,
    box_of_points,
    box_of_smoke,
    framed_box,
    read_bounds,
    write_bounds,
)
from render.camera_path import CameraPath, View
from render.errors import InvalidFileError
from render.parameters import CameraParameters

DOMAIN = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
LOW_AND_WIDE = np.array([[-0.4, -0.1, 0.0], [0.4, 0.3, 0.2]])


def test_one_droplet_that_flies_off_does_not_widen_the_box():
    pool = np.random.default_rng(3).uniform((-0.4, -0.4, 0.0), (0.4, 0.4, 0.2), (20_000, 3))
    calm = box_of_particles(pool, 0.01)
    splashed = box_of_particles(np.concatenate([pool, [[3.0, -2.0, 9.0]]]), 0.01)
    # One of 20,000 moves a quantile by a fraction of the distance between particles.
    assert splashed == pytest.approx(calm, abs=1e-4)
    assert calm == pytest.approx(np.array([[-0.41, -0.41, -0.01], [0.41, 0.41, 0.21]]), abs=0.004)


def test_a_crown_of_some_percent_of_the_water_is_in_the_box():
    pool = np.random.default_rng(3).uniform((-0.4, -0.4, 0.0), (0.4, 0.4, 0.2), (20_000, 3))
    pool[:400, 2] += 0.5  # two percent of it
    assert box_of_particles(pool, 0.0)[1, 2] > 0.65


def test_thin_smoke_on_the_rim_is_left_out_and_no_smoke_has_no_box():
    density = np.full((40, 40, 80), 1e-5, np.float32)
    density[10:20, 15:25, 5:60] = 1.0
    box = box_of_smoke(density, (1.0, 2.0, 3.0), 0.1)
    assert box == pytest.approx(np.array([[2.0, 3.5, 3.5], [3.0, 4.5, 9.0]]))
    assert box_of_smoke(np.zeros((4, 4, 4), np.float32), (0, 0, 0), 0.1) is None
    assert box_of_smoke(np.zeros((0, 0, 0), np.float32), (0, 0, 0), 0.1) is None


def test_what_leaves_the_world_is_not_followed_and_a_point_is_no_picture():
    flown = around([LOW_AND_WIDE, box_of_points([[0.0, 0.0, 7.0]])])
    assert flown is not None
    box = framed_box(flown, domain=DOMAIN, world=DOMAIN)
    assert box.tolist() == [LOW_AND_WIDE[0].tolist(), [0.4, 0.3, 1.0]]
    point = framed_box(box_of_points([[0.1, 0.1, 0.5]]), domain=DOMAIN, world=DOMAIN)
    assert (point[1] - point[0]) == pytest.approx(np.full(3, 0.1 * 3**0.5))
    assert point.mean(axis=0) == pytest.approx([0.1, 0.1, 0.5])
    for nothing in (None, box_of_points([[0.0, 0.0, 7.0]])):
        assert framed_box(nothing, domain=DOMAIN, world=DOMAIN) is DOMAIN


def test_bounds_survive_the_file_and_nonsense_is_refused(tmp_path):
    path = tmp_path / "bounds.json"
    write_bounds(path, {"water": LOW_AND_WIDE})
    assert (read_bounds(path)["water"] == LOW_AND_WIDE).all()
    for text in (
        "",
        "[]",
        '{"version": 2, "boxes": {}}',
        '{"version": 1, "boxes": {"water": [[0, 0, 0]]}}',
        '{"version": 1, "boxes": {"water": [[0, 0, 1], [1, 1, 0]]}}',
    ):
        path.write_text(text)
        with pytest.raises(InvalidFileError):
            read_bounds(path)


def seen_from(view: View, points: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    """Where points are in the picture, (n, 2): -1 and 1 are its edges."""
    forward = np.subtract(view.look_at, view.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    offset = points - view.position
    plane = np.stack([offset @ right, offset @ np.cross(right, forward)], axis=1) / (offset @ forward)[:, None]
    return plane * view.focal_length_mm / 18.0 * [1.0, aspect]


@pytest.mark.parametrize("orbit_deg_per_s", [0.0, 30.0])
def test_a_camera_that_frames_a_box_keeps_all_of_it_in_every_picture(orbit_deg_per_s):
    aspect = 16 / 9
    camera = CameraParameters(framing="action", orbit_deg_per_s=orbit_deg_per_s)
    path = CameraPath(camera, *DOMAIN, aspect=aspect, starts={}, framed=LOW_AND_WIDE)
    corners = np.array(list(itertools.product(*LOW_AND_WIDE.T)))
    extents = [abs(seen_from(path.view(time, {}), corners, aspect)).max() for time in np.linspace(0.0, 12.0, 25)]
    assert max(extents) <= 0.9 + 1e-9
    assert max(extents) > 0.85  # and no smaller than it has to be
    first, middle = path.first(), LOW_AND_WIDE.mean(axis=0)
    if orbit_deg_per_s:
        assert np.array(first.look_at[:2]) == pytest.approx(middle[:2])


def test_without_a_box_the_domain_is_framed():
    action, domain = (
        CameraPath(CameraParameters(framing=framing), *DOMAIN, aspect=16 / 9, starts={})
        for framing in ("action", "domain")
    )
    assert action.first() == domain.first()


def test_framing_the_action_beside_a_place_is_refused():
    for place in ({"position": (0, -2, 1)}, {"keyframe": ({"time_s": 0, "position": (0, -2, 1)},)}):
        with pytest.raises(ValidationError, match='framing = "action" has no meaning beside'):
            CameraParameters.model_validate({"framing": "action", **place})
        assert not CameraParameters.model_validate({"framing": "domain", **place}).frames_action
