"""Boxes around what moves, and the camera that frames them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from render.bounds import (
    DIRECTIONS,
    around,
    box_of,
    box_of_smoke,
    corners_of,
    framed,
    reach_of_box,
    reach_of_particles,
    reach_of_points,
    read_bounds,
    write_bounds,
)
from render.camera_path import CameraPath
from render.errors import InvalidFileError
from render.parameters import CameraParameters
from render.visibility import screen_positions

DOMAIN = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
LOW_AND_WIDE = np.array([[-0.4, -0.1, 0.0], [0.4, 0.3, 0.2]])


def corners(box: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array(list(itertools.product(*box.T)))


def block(count: int, low: tuple[float, float, float], high: tuple[float, float, float]) -> NDArray[np.float64]:
    """Particles all over a box, so many."""
    return np.random.default_rng(3).uniform(low, high, (count, 3))


POOL = (-0.4, -0.4, 0.0), (0.4, 0.4, 0.2)
POOL_RADIUS = 0.5 * (0.8 * 0.8 * 0.2 / 20_000) ** (1 / 3)  # of each of 20,000 particles that fill the pool [m]


def test_every_direction_has_its_opposite_and_no_two_are_the_same():
    assert DIRECTIONS.shape == (50, 3)
    assert (DIRECTIONS[::-1] == -DIRECTIONS).all()
    units = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    np.fill_diagonal(cosines := units @ units.T, -1.0)
    assert np.rad2deg(np.arccos(cosines.max())) > 18.0  # the nearest are those of (1, 0, 0) or (1, 1, 0) and (2, 1, 0)
    # Wherever one looks, a direction is near: 22 degrees off, a sphere is taken to be 8 % larger than it is.
    anywhere = np.random.default_rng(0).normal(size=(20_000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1)[:, None]
    assert np.rad2deg(np.arccos((anywhere @ units.T).max(axis=1).min())) < 22.5


def test_the_corners_of_a_box_and_of_an_octahedron_are_found_from_how_far_they_reach():
    box = np.array([[-1.0, 2.0, 0.5], [3.0, 2.5, 4.0]])
    found = corners_of(reach_of_box(box))
    assert len(np.unique(found.round(9) + 0.0, axis=0)) == 8
    assert (np.sort(np.unique(found.round(9) + 0.0, axis=0), axis=0) == np.sort(corners(box), axis=0)).all()
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    found = np.unique(corners_of(reach_of_points(octahedron)).round(9) + 0.0, axis=0)
    assert found == pytest.approx(np.unique(octahedron, axis=0))
    assert (reach_of_box(box) == reach_of_points(corners(box))).all()


def test_what_is_bounded_is_inside_and_takes_less_room_than_its_box():
    tilted = block(2000, (-0.5, -0.05, -0.05), (0.5, 0.05, 0.05)) @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
    reach = reach_of_points(tilted)
    assert (tilted @ DIRECTIONS.T <= reach + 1e-12).all()
    found = corners_of(reach)
    box = box_of(reach)
    assert ((found >= box[0] - 1e-9) & (found <= box[1] + 1e-9)).all()

    def width(points: NDArray[np.float64]) -> float:
        return float(np.ptp(points @ (0.8, -0.6, 0.0)))

    # The stick is 0.1 m across. Its box is 0.9 m wide as seen along it; the nearest direction is 8 degrees off.
    assert width(corners(box)) > 0.8
    assert width(found) < 0.4


def test_one_droplet_that_flies_off_does_not_widen_what_is_framed():
    pool = block(20_000, *POOL)
    calm = reach_of_particles(pool, POOL_RADIUS)
    for place in ([3.0, -2.0, 9.0], [0.39, 0.39, 0.9], [0.37, -0.37, 0.19]):
        splashed = reach_of_particles(np.concatenate([pool, [place]]), POOL_RADIUS)
        # One of 20,000 moves a quantile by a fraction of the distance between particles.
        assert splashed == pytest.approx(calm, abs=2e-3)
    grown = np.array(POOL) + POOL_RADIUS * np.array([[-1.0], [1.0]])
    assert box_of(calm) == pytest.approx(grown, abs=0.002)


def test_the_corners_of_a_block_of_water_are_in_the_picture():
    """They hold less than the share that is left out on a side."""
    spacing = 0.02
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in (40, 40, 10)), indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = (lattice + 0.5) * spacing
    calm = reach_of_particles(lattice, 0.5 * spacing)
    whole = reach_of_box(np.array([[0.0, 0.0, 0.0], [0.8, 0.8, 0.2]]))
    missing = (whole - calm) / np.linalg.norm(DIRECTIONS, axis=1)
    assert box_of(calm) == pytest.approx(np.array([[0.0, 0.0, 0.0], [0.8, 0.8, 0.2]]))
    assert missing.max() < spacing  # the spheres of its corners have none: 0.37 of a spacing along the diagonal


def test_spray_between_the_axes_is_left_out_and_a_crown_is_not():
    pool, radius = block(20_000, *POOL), POOL_RADIUS
    spray = block(30, (0.25, 0.25, 0.45), (0.4, 0.4, 0.6))  # as sparse as 0.02 m of water in such a cube's middle
    sheet = block(800, (0.25, -0.4, 0.2), (0.29, 0.4, 0.6))
    up_and_out = int(np.flatnonzero((DIRECTIONS == (1.0, 1.0, 1.0)).all(axis=1))[0])
    with_sheet = reach_of_particles(np.concatenate([pool, sheet]), radius)
    with_both = reach_of_particles(np.concatenate([pool, sheet, spray]), radius)
    assert with_sheet[up_and_out] == pytest.approx(0.29 + 0.4 + 0.6, abs=0.1)
    assert with_both[up_and_out] < with_sheet[up_and_out] + 0.05
    assert (0.4 + 0.4 + 0.6) - with_both[up_and_out] > 0.05


def test_a_crown_of_some_percent_of_the_water_is_in_the_box():
    pool = block(20_000, *POOL)
    pool[:400, 2] += 0.5  # two percent of it
    assert box_of(reach_of_particles(pool, POOL_RADIUS))[1, 2] > 0.65


def test_thin_smoke_on_the_rim_is_left_out_and_no_smoke_has_no_box():
    density = np.full((40, 40, 80), 1e-5, np.float32)
    density[10:20, 15:25, 5:60] = 1.0
    box = box_of_smoke(density, (1.0, 2.0, 3.0), 0.1)
    assert box == pytest.approx(np.array([[2.0, 3.5, 3.5], [3.0, 4.5, 9.0]]))
    assert box_of_smoke(np.zeros((4, 4, 4), np.float32), (0, 0, 0), 0.1) is None
    assert box_of_smoke(np.zeros((0, 0, 0), np.float32), (0, 0, 0), 0.1) is None


def test_what_leaves_the_world_is_not_followed_and_a_point_is_no_picture():
    flown = around([reach_of_box(LOW_AND_WIDE), reach_of_points([[0.0, 0.0, 7.0]])])
    assert flown is not None
    box = box_of(framed(flown, domain=DOMAIN, world=DOMAIN))
    assert box.tolist() == [LOW_AND_WIDE[0].tolist(), [0.4, 0.3, 1.0]]
    point = corners_of(framed(reach_of_points([[0.1, 0.1, 0.5]]), domain=DOMAIN, world=DOMAIN))
    assert np.ptp(point, axis=0) == pytest.approx(np.full(3, 0.1 * 3**0.5))
    assert (point.min(axis=0) + point.max(axis=0)) / 2 == pytest.approx([0.1, 0.1, 0.5])
    # The last one's box is in the world with a corner, and it itself is not.
    past_a_corner = reach_of_points([[0.4, 1.2, 0.5], [1.2, 0.4, 0.5]])
    for nothing in (None, reach_of_points([[0.0, 0.0, 7.0]]), past_a_corner):
        assert (framed(nothing, domain=DOMAIN, world=DOMAIN) == reach_of_box(DOMAIN)).all()


def test_bounds_survive_the_file_and_nonsense_is_refused(tmp_path):
    path = tmp_path / "bounds.json"
    reach = reach_of_points(block(100, *POOL))
    write_bounds(path, {"water": reach})
    assert (read_bounds(path)["water"] == reach).all()
    for text, reason in (
        ("", "holds no bounds"),
        ("[]", "holds no bounds"),
        ('{"version": 1, "boxes": {"action": [[0, 0, 0], [1, 1, 1]]}}', "is of version 1, this program reads 2"),
        ('{"version": 3, "reaches": {}}', "is of version 3, this program reads 2"),
        ('{"version": 2, "reaches": {"water": [0, 0, 0]}}', '"water" bounds nothing'),
        (f'{{"version": 2, "reaches": {{"water": {[-1.0] * 50}}}}}', '"water" bounds nothing'),
        ('{"version": 2, "boxes": {}}', "holds no bounds"),
    ):
        path.write_text(text)
        with pytest.raises(InvalidFileError, match=reason):
            read_bounds(path)


@pytest.mark.parametrize("orbit_deg_per_s", [0.0, 30.0])
def test_a_camera_that_frames_a_box_keeps_all_of_it_in_every_picture(orbit_deg_per_s):
    aspect = 16 / 9
    camera = CameraParameters(framing="action", orbit_deg_per_s=orbit_deg_per_s)
    points = corners(LOW_AND_WIDE)
    path = CameraPath(camera, *DOMAIN, aspect=aspect, starts={}, framed=points)
    extents = [
        abs(screen_positions(path.view(time, {}), points, aspect=aspect)).max() for time in np.linspace(0.0, 12.0, 25)
    ]
    assert max(extents) <= 0.9 + 1e-9
    assert max(extents) > 0.85  # and no smaller than it has to be
    first, middle = path.first(), LOW_AND_WIDE.mean(axis=0)
    if orbit_deg_per_s:
        assert np.array(first.look_at[:2]) == pytest.approx(middle[:2])


def test_a_camera_around_what_is_narrow_above_comes_nearer_than_to_its_box():
    foot, tip = corners(np.array([[-0.4, -0.4, 0.0], [0.4, 0.4, 0.1]])), np.array([[0.0, 0.0, 1.0]])
    reach = reach_of_points(np.concatenate([foot, tip]))
    camera = CameraParameters(framing="action", orbit_deg_per_s=30.0)
    near, far = (
        CameraPath(camera, *DOMAIN, aspect=9 / 16, starts={}, framed=points).first()
        for points in (corners_of(reach), corners(box_of(reach)))
    )
    distance = [float(np.linalg.norm(np.subtract(view.position, view.look_at))) for view in (near, far)]
    assert distance[0] < 0.96 * distance[1]


def test_without_a_box_the_domain_is_framed():
    action, domain = (
        CameraPath(CameraParameters(framing=framing), *DOMAIN, aspect=16 / 9, starts={})
        for framing in ("action", "domain")
    )
    assert action.first() == domain.first()


def test_framing_the_action_beside_what_says_where_the_camera_is_or_looks_is_refused():
    places = ({"position": (0, -2, 1)}, {"keyframe": ({"time_s": 0, "position": (0, -2, 1)},)})
    for place in (*places, {"follow": "duck"}, {"look_at": "duck"}, {"look_at": (0, 0, 1)}):
        with pytest.raises(ValidationError, match='framing = "action" has no meaning beside'):
            CameraParameters.model_validate({"framing": "action", **place})
        assert not CameraParameters.model_validate({"framing": "domain", **place}).frames_action
