"""Pictures of whitewater by the real Cycles: tiny, few samples, in child processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import RENDER_FRAMES, RESOLUTION, read, spec_of, sphere, write_mesh
from needed_blender import needs_bpy
from warm_python import run_python

from pipeline.model.looks import WHITEWATER
from render.parameters import MaterialParameters
from render.point_clouds import KINDS, PointCloud, write_point_cloud
from render.spec import MeshSequenceObject, PointSequenceObject

pytestmark = needs_bpy

SPRAY, FOAM, BUBBLES = range(3)
GROUND_ROW = 29
DARK = MaterialParameters(look="plastic", color=(0.02, 0.02, 0.02), roughness=1.0)
PIXELS_PER_M = RESOLUTION[0] * 50.0 / 36.0 / 2.5  # in the plane y = 0, which the camera of `spec_of` sees from 2.5 m


def objects() -> list:
    """A dark wall with the three kinds in front of it."""
    wall = MeshSequenceObject(name="wall", file="wall/{frame}.ply", material=DARK)
    return [wall] + [
        PointSequenceObject(name=f"water.{kind}", file="points/{frame}.ply", kind=kind, material=WHITEWATER[kind])
        for kind in KINDS
    ]


def points(position, *, kind: int, radius: float = 0.1, velocity=(0.0, 0.0, 0.0), lifetime: float = 2.0) -> PointCloud:
    rows = np.atleast_2d(np.asarray(position, np.float32))
    return PointCloud(
        position=rows,
        velocity=np.broadcast_to(np.asarray(velocity, np.float32), rows.shape).copy(),
        radius=np.full(len(rows), radius, np.float32),
        lifetime=np.full(len(rows), lifetime, np.float32),
        kind=np.full(len(rows), kind, np.uint8),
    )


EMPTY = points(np.zeros((0, 3)), kind=FOAM)
LEFT, RIGHT = (-0.3, 0.0, 0.5), (0.3, 0.0, 0.5)
FRAMES = [
    EMPTY,
    points(LEFT, kind=FOAM),
    points(RIGHT, kind=FOAM),
    points(LEFT, kind=SPRAY),
    points(LEFT, kind=BUBBLES),
    points((0.0, 0.0, 0.5), kind=FOAM, velocity=(36.0, 0.0, 0.0)),
    points((0.0, 0.0, 0.5), kind=FOAM),
    points((0.0, 0.0, 0.5), kind=FOAM, lifetime=0.25 / 8),
]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> tuple[Path, list[np.ndarray], str]:
    """Folder, every frame's luminance, and what was printed about three broken frames after them."""
    folder = tmp_path_factory.mktemp("whitewater")
    (folder / "points").mkdir()
    ball, triangles = sphere((0.0, 3.0, 0.5), 2.4)
    for frame, cloud in enumerate(FRAMES):
        write_point_cloud(folder / f"points/{frame:06d}.ply", cloud)
    for frame in range(len(FRAMES) + 3):
        write_mesh(folder / f"wall/{frame:06d}.ply", ball, triangles, velocity=(0.0, 0.0, 0.0))
    broken = points(LEFT, kind=FOAM)
    broken.radius[0] = np.nan
    write_point_cloud(folder / f"points/{len(FRAMES):06d}.ply", broken)
    whole = (folder / "points/000001.ply").read_bytes()
    (folder / f"points/{len(FRAMES) + 1:06d}.ply").write_bytes(whole[:-5])
    (folder / f"points/{len(FRAMES) + 2:06d}.ply").write_bytes(whole.replace(b"float radius", b"float size"))
    spec_of(*objects(), samples=16, motion_blur=True).write(folder / "spec.json")
    frames = ",".join(map(str, [*range(len(FRAMES) + 3), 0]))
    printed = run_python(RENDER_FRAMES, str(folder), "{frame}.png", frames)
    # Below the wall is the ground, with shadows of its own.
    return folder, [read(folder / f"{frame}.png").mean(axis=2)[:GROUND_ROW] for frame in range(len(FRAMES))], printed


def brighter(picture: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Where a picture is brighter by over half of what it is at most: light that bounces to the wall is less."""
    difference = picture - background
    return difference > 0.5 * difference.max()


@pytest.mark.parametrize("frame", [1, 3, 4], ids=["foam", "spray", "bubbles"])
def test_pixels_change_where_whitewater_is_and_nowhere_else(pictures, frame):
    _, drawn, _ = pictures
    # Of 255. Noise of 16 samples and light that bounces to the wall stay below it.
    changed = np.abs(drawn[frame] - drawn[0]) > 25
    rows, columns = np.nonzero(changed)
    assert len(rows) > 5
    middle = (RESOLUTION[0] / 2 + PIXELS_PER_M * LEFT[0], RESOLUTION[1] / 2)
    # A ball of 0.1 m is 3.6 pixels in radius here; half a pixel for where the edges fall, one for bounced light.
    assert np.hypot(columns + 0.5 - middle[0], rows + 0.5 - middle[1]).max() < 0.1 * PIXELS_PER_M + 1.5


@pytest.mark.parametrize("frame", [1, 3], ids=["foam", "spray"])
def test_foam_and_spray_are_white(pictures, frame):
    _, drawn, _ = pictures
    lit = (drawn[frame] - drawn[0])[brighter(drawn[frame], drawn[0])]
    # Of the 40 pixels of its disc most are lit, and far above the wall at some 30 of 255.
    assert len(lit) > 15
    assert lit.mean() > 60


def test_foam_has_the_area_of_its_projection_and_moves(pictures):
    _, drawn, _ = pictures
    masks = [brighter(drawn[frame], drawn[0]) for frame in (1, 2)]
    for mask in masks:
        # Half a pixel of radius either way: pixels on the rim are mixed.
        assert np.sqrt(mask.sum() / np.pi) == pytest.approx(0.1 * PIXELS_PER_M, abs=0.7)
    left, right = (np.nonzero(mask)[1].mean() for mask in masks)
    assert right - left == pytest.approx(0.6 * PIXELS_PER_M, abs=0.6)


def test_velocity_blurs_along_the_motion(pictures):
    _, drawn, _ = pictures
    middle = slice(RESOLUTION[1] // 2 - 2, RESOLUTION[1] // 2 + 2)
    profiles = [(drawn[frame] - drawn[0])[middle].mean(axis=0) for frame in (5, 6)]
    flying, still = (int((profile > 0.5 * profile.max()).sum()) for profile in profiles)
    travelled = PIXELS_PER_M * 36.0 * 0.5 / 60.0
    diameter = 0.2 * PIXELS_PER_M
    # A pixel is lit for as long as the ball is over it. The whole trace is as wide as way and ball together, and at
    # half of its light as wide as the way; half of the displayed value is less light. A pixel at each end for edges.
    assert travelled - 2 <= flying <= travelled + diameter + 2
    assert still == pytest.approx(diameter, abs=2)
    assert flying >= still + 3


def test_a_particle_shrinks_at_the_end_of_its_life(pictures):
    _, drawn, _ = pictures
    areas = [brighter(drawn[frame], drawn[0]).sum() for frame in (6, 7)]
    # An eighth of the fading time is left: half the radius, a quarter of the area; pixels of the rim count either way.
    assert 0.1 < areas[1] / areas[0] < 0.45


def test_an_empty_cloud_draws_the_same_as_none(pictures, tmp_path):
    folder, _, _ = pictures
    (tmp_path / "wall").mkdir()
    (tmp_path / "wall/000000.ply").write_bytes((folder / "wall/000000.ply").read_bytes())
    spec_of(objects()[0], samples=16, motion_blur=True).write(tmp_path / "spec.json")
    run_python(RENDER_FRAMES, str(tmp_path), "{frame}.png", "0")
    assert (tmp_path / "0.png").read_bytes() == (folder / "0.png").read_bytes()


def test_broken_files_are_refused_with_frame_and_file(pictures):
    refused = [line for line in pictures[2].splitlines() if line.startswith("REFUSED")]
    assert len(refused) == 3
    assert f"frame {len(FRAMES)}:" in refused[0] and "1 values that are not finite" in refused[0]
    assert "truncated" in refused[1]
    assert "is not a point cloud of the expected layout" in refused[2]
