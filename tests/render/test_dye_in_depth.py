"""Dye in clear liquids: how much of it lies behind a surface, and what light loses to it."""

from __future__ import annotations

import numpy as np
import pytest
from blender_scenes import draw_all, spec_of
from needed_blender import needs_bpy

from blender_scripts.optics import dye_per_metre, per_metre
from render.dye import dye_behind
from render.meshes import read_ply, write_ply
from render.parameters import MaterialParameters
from render.point_clouds import PointCloud, write_point_cloud
from render.spec import MeshSequenceObject, PointSequenceObject

RADIUS = 0.005


def block(*counts: int) -> np.ndarray:
    """Particles whose liquid fills a box from the origin."""
    axes = [np.arange(count) + 0.5 for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2.0 * RADIUS


def test_dye_behind_a_face_is_as_deep_as_the_liquid_times_its_concentration():
    positions = block(20, 8, 8)
    places = np.array([[0.2, 0.04, 0.04], [0.1, 0.04, 0.08], [0.05, 0.0, 0.035]])
    normals = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for dye in (np.ones(len(positions)), np.full(len(positions), 0.25)):
        found = dye_behind(places, normals, positions, dye, particle_radius=RADIUS)
        np.testing.assert_allclose(found[:, 0], dye[0] * np.array([0.2, 0.08, 0.08]), rtol=0.06)
    # The left half is dyed: half of what lies behind the right face, all behind the bottom of the left.
    half = dye_behind(places, normals, positions, positions[:, 0] < 0.1, particle_radius=RADIUS)
    np.testing.assert_allclose(half[[0, 2], 0], [0.1, 0.08], rtol=0.06)


def test_dye_of_another_part_beyond_the_air_is_not_behind():
    near, far = block(4, 8, 8), block(4, 8, 8) + np.array([0.1, 0.0, 0.0])
    positions = np.concatenate([near, far])
    face, normal = np.array([[0.0, 0.04, 0.04]]), np.array([[-1.0, 0.0, 0.0]])
    found = dye_behind(face, normal, positions, np.ones(len(positions)), particle_radius=RADIUS)
    assert found[0, 0] == pytest.approx(0.04, rel=0.15)
    only_far = np.r_[np.zeros(len(near)), np.ones(len(far))]
    assert dye_behind(face, normal, positions, only_far, particle_radius=RADIUS)[0, 0] == 0.0
    nothing = dye_behind(np.empty((0, 3)), np.empty((0, 3)), positions, only_far, particle_radius=RADIUS)
    assert nothing.shape == (0, 1)


def test_dye_of_full_concentration_makes_the_colour_that_a_job_would_give():
    red = (0.8, 0.05, 0.05)
    for color, density in ((None, 2.2), ((0.9, 0.9, 0.9), 10.0)):
        added = dye_per_metre("water", density, color, red)
        own = per_metre("water", density, color)
        expected = np.maximum(own, per_metre("water", 10.0, red))  # a dye brings no light
        np.testing.assert_allclose(np.add(own, added), expected, rtol=1e-5)
    assert dye_per_metre("ink", 1.0, None, (0.9, 0.9, 0.9)) == (0.0, 0.0, 0.0)


def box(low, high, cells: int):
    """A closed box of equal cells on each face: vertices, outward triangles, normals."""
    positions, triangles, normals = [], [], []
    low, high = np.array(low), np.array(high)
    steps = np.linspace(0.0, 1.0, cells + 1)
    for axis in range(3):
        for side in (0.0, 1.0):
            u, v = np.meshgrid(steps, steps, indexing="ij")
            unit = np.empty((u.size, 3))
            unit[:, axis], unit[:, (axis + 1) % 3], unit[:, (axis + 2) % 3] = side, u.ravel(), v.ravel()
            first = sum(map(len, positions))
            i, j = (each.ravel() for each in np.mgrid[0:cells, 0:cells])
            a, b, c, d = (first + (i + m) * (cells + 1) + j + n for m, n in ((0, 0), (1, 0), (1, 1), (0, 1)))
            quads = [np.stack(each, axis=1) for each in ((a, b, c), (a, c, d))]
            triangles += quads if side else [each[:, ::-1] for each in quads]
            positions.append(low + unit * (high - low))
            normals.append(np.broadcast_to(np.eye(3)[axis] * (2.0 * side - 1.0), unit.shape))
    return np.concatenate(positions), np.concatenate(triangles), np.concatenate(normals)


@needs_bpy
def test_a_clear_liquid_is_as_dark_with_dye_as_one_of_its_colour(tmp_path):
    """A tank, dyed on the right: there it looks as one of that colour does, on the left as without dye."""
    size = np.array([0.9, 0.4, 0.85])
    positions, triangles, normals = box((-0.45, -0.2, 0.05), (0.45, 0.2, 0.9), 24)
    dye = (positions[:, :1] > 0.0).astype(float)
    behind = np.abs(normals) @ (size * [0.5, 1.0, 1.0])[:, None] * dye
    write_ply(
        tmp_path / "water000000.ply",
        positions,
        triangles,
        normals=normals,
        velocities=0 * positions,
        dye=dye,
        dye_behind=behind,
    )
    np.testing.assert_array_equal(read_ply(tmp_path / "water000000.ply").dye_behind, behind.astype(np.float32))
    pale, red = (0.98, 0.98, 0.98), (0.9, 0.2, 0.2)
    pictures = []
    for keys in ({"color": pale}, {"color": pale, "dye_color": red}, {"color": red}):
        material = MaterialParameters(look="water", density=10.0, **keys)
        water = MeshSequenceObject(name="water", file="water{frame}.ply", material=material)
        (picture,) = draw_all(tmp_path, spec_of(water, samples=64, motion_blur=False))
        pictures.append(picture)
    rows, left, right = np.s_[12:24], np.s_[20:28], np.s_[36:44]
    plain_left, dyed_left, _ = (each[rows, left].mean(axis=(0, 1)) for each in pictures)
    plain, dyed, colored = (each[rows, right].mean(axis=(0, 1)) for each in pictures)
    np.testing.assert_allclose(dyed_left, plain_left, rtol=0.1)
    assert (colored / plain)[1] < 0.7
    np.testing.assert_allclose(dyed / plain, colored / plain, atol=0.08)


@needs_bpy
def test_a_drop_has_the_colour_of_its_dye(tmp_path):
    """Two drops in front of the white background, of which the right one is dyed."""
    rows = np.array([[-0.3, 0.0, 0.5], [0.3, 0.0, 0.5]], np.float32)
    ones = np.ones(2, np.float32)
    cloud = PointCloud(rows, 0 * rows, 0.2 * ones, ones, np.zeros(2, np.uint8), dye=np.array([0.0, 1.0], np.float32))
    write_point_cloud(tmp_path / "drops000000.ply", cloud)
    material = MaterialParameters(look="drops", color=(1.0, 1.0, 1.0), dye_color=(0.9, 0.1, 0.1))
    drops = PointSequenceObject(name="drops", file="drops{frame}.ply", kind="spray", material=material)
    (picture,) = draw_all(tmp_path, spec_of(drops, samples=64, motion_blur=False))
    left, right = (picture[14:22, columns].mean(axis=(0, 1)) for columns in (np.s_[20:24], np.s_[40:44]))
    # Nine in a hundred of green for ninety of red, but for what the drop mirrors.
    assert (right / left)[1] < 0.3 * (right / left)[0]
    assert left[1] > 0.8 * left[0]
