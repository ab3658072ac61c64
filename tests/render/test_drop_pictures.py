"""Pictures of drops by the real Cycles: tiny, few samples, in child processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import PIXELS_PER_METRE, RED, RESOLUTION, draw_all, spec_of, sphere, write_mesh
from needed_blender import needs_bpy

from pipeline.model.looks import POINTS
from render.parameters import MaterialParameters
from render.point_clouds import PointCloud, write_point_cloud
from render.spec import MeshSequenceObject, PointSequenceObject

pytestmark = needs_bpy

MIDDLE = (0.0, 0.0, 0.5)
RADIUS = 0.2
BLUE = RED.model_copy(update={"color": (0.02, 0.02, 0.8)})
NO_ABSORPTION = MaterialParameters(look="water", density=1e-6)
EMPTY, DROP, BALL, MIST, DENSE = range(5)


def write_drops(path: Path, positions: np.ndarray, radius: float) -> None:
    rows = np.asarray(positions, np.float32).reshape(-1, 3)
    radii = np.float32(radius) * np.linspace(0.99, 1.01, len(rows), dtype=np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_point_cloud(
        path, PointCloud(rows, np.zeros_like(rows), radii, np.ones_like(radii), np.zeros(len(rows), np.uint8))
    )


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> list[np.ndarray]:
    """A red and a blue ball behind nothing, a drop, a ball of water, fine drops, and more than paths can follow."""
    folder = tmp_path_factory.mktemp("drops")
    random = np.random.default_rng(0)
    half_a_pixel = 0.5 / PIXELS_PER_METRE
    clouds = {
        DROP: (MIDDLE, RADIUS),
        MIST: (random.uniform([-0.5, 0.0, 0.3], [0.5, 0.3, 0.7], (4000, 3)), 0.4 * half_a_pixel),
        DENSE: (random.uniform([-0.3, 0.0, 0.3], [0.3, 0.6, 0.7], (6000, 3)), 0.9 * half_a_pixel),
    }
    for frame in range(5):
        write_drops(folder / f"drops/{frame:06d}.ply", *clouds.get(frame, (np.zeros((0, 3)), 1.0)))
        ball, triangles = sphere(MIDDLE, RADIUS if frame == BALL else 1e-4, rings=96, segments=192)
        write_mesh(folder / f"ball/{frame:06d}.ply", ball, triangles, velocity=(0.0, 0.0, 0.0))
        for name, x in (("red", -0.75), ("blue", 0.75)):
            write_mesh(folder / f"{name}/{frame:06d}.ply", *sphere((x, 1.6, 0.5), 0.7), velocity=(0.0, 0.0, 0.0))
    spec = spec_of(
        MeshSequenceObject(name="red", file="red/{frame}.ply", material=RED),
        MeshSequenceObject(name="blue", file="blue/{frame}.ply", material=BLUE),
        MeshSequenceObject(name="ball", file="ball/{frame}.ply", material=NO_ABSORPTION),
        PointSequenceObject(name="drops", file="drops/{frame}.ply", kind="spray", material=POINTS["drops"]),
        samples=64,
    )
    return draw_all(folder, spec, range(5))


def distance_from_middle() -> np.ndarray:
    rows, columns = np.indices(RESOLUTION[::-1])
    return np.hypot(columns + 0.5 - RESOLUTION[0] / 2, rows + 0.5 - RESOLUTION[1] / 2) / PIXELS_PER_METRE


def redness(picture: np.ndarray, side: int) -> float:
    """Mean of red less blue in the middle rows, left (-1) or right (1) of the middle."""
    half = RESOLUTION[0] // 2
    rows = slice(RESOLUTION[1] // 2 - 2, RESOLUTION[1] // 2 + 2)
    columns = slice(half - 4, half - 1) if side < 0 else slice(half + 1, half + 4)
    return float((picture[rows, columns, 0] - picture[rows, columns, 2]).mean())


def test_a_drop_looks_like_a_ball_of_water(pictures):
    disc = distance_from_middle() < 0.95 * RADIUS
    unlike = np.abs(pictures[EMPTY] - pictures[BALL])[disc].mean()
    assert np.abs(pictures[DROP] - pictures[BALL])[disc].mean() < 0.35 * unlike
    assert redness(pictures[EMPTY], -1) > redness(pictures[EMPTY], 1)
    for frame in (DROP, BALL):  # upside down, and what is left of it on the right
        assert redness(pictures[frame], -1) < redness(pictures[frame], 1) - 20


def test_a_drop_casts_no_shadow_and_no_light(pictures):
    outside = distance_from_middle() > RADIUS + 1.5 / PIXELS_PER_METRE
    changed = [(pictures[frame] != pictures[EMPTY])[outside].mean() for frame in (DROP, BALL)]
    assert changed[0] < 0.02  # mirrors show it
    assert changed[1] > 0.05  # a ball of water has a shadow


def covered(picture: np.ndarray, empty: np.ndarray) -> float:
    """Share of the pixels about the middle that differ by what noise does not."""
    return float((np.abs(picture - empty).max(axis=2) > 12)[14:22, 22:42].mean())


def test_fewer_larger_drops_stand_for_those_that_no_pixel_shows(pictures):
    """Of one pixel, and of the same volume: of n in a box they leave the share exp(-n pi r² / area) free."""
    number = 4000 * 0.2**3
    free = np.exp(-number * np.pi / PIXELS_PER_METRE**2 / 0.4)
    # A drop that is two pixels wide changes pixels that it covers in part.
    assert 1.0 < covered(pictures[MIST], pictures[EMPTY]) / (1.0 - free) < 4.0
    behind = np.median((pictures[MIST] - pictures[EMPTY])[14:22, 22:42], axis=(0, 1))
    assert np.abs(behind).max() < 4, "between them is what was there"


def test_many_drops_behind_each_other_are_not_black(pictures):
    middle = distance_from_middle() < 0.15
    assert np.abs(pictures[DENSE] - pictures[EMPTY]).mean(axis=2)[middle].mean() > 5
    darkest = np.percentile(pictures[DENSE].max(axis=2)[middle], 2)
    assert darkest > 0.5 * pictures[EMPTY].max(axis=2)[middle].min()
