"""Dye on a fluid's surface: what the particles below it carry, and the colour that is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import PIXELS_PER_METRE, RESOLUTION, draw_all, spec_of, sphere
from needed_blender import needs_bpy

from render.dye import dye_at
from render.grains import grains_of
from render.meshes import read_ply, write_ply
from render.parameters import MaterialParameters
from render.point_clouds import write_point_cloud
from render.spec import MeshSequenceObject, PointSequenceObject

RADIUS = 0.005


def block(*counts: int) -> np.ndarray:
    axes = [np.arange(count) for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2.0 * RADIUS


def test_dye_of_a_slope_is_found_between_the_particles():
    positions = block(20, 6, 6)
    inside = np.random.default_rng(0).uniform((0.05, 0.02, 0.02), (0.14, 0.03, 0.03), (200, 3))
    found = dye_at(inside, positions, positions[:, 0] / 0.2, particle_radius=RADIUS)
    # Of a linear field the mean is exact up to the lattice's own second moments.
    np.testing.assert_allclose(found[:, 0], inside[:, 0] / 0.2, atol=0.01)


def test_dye_never_goes_beyond_that_of_the_particles_and_is_there_for_what_is_far_from_all():
    positions = block(4, 4, 4)
    dye = np.random.default_rng(1).uniform(0.2, 0.6, len(positions))
    places = np.random.default_rng(2).uniform(-0.01, 0.05, (500, 3))
    found = dye_at(places, positions, dye, particle_radius=RADIUS)
    assert 0.2 < found.min() < found.max() < 0.6
    assert dye_at([(1.0, 0.0, 0.0)], positions, dye, particle_radius=RADIUS).ravel() == pytest.approx(
        dye[np.argmin(np.linalg.norm(positions - (1.0, 0.0, 0.0), axis=1))]
    )
    assert dye_at(np.empty((0, 3)), positions, dye, particle_radius=RADIUS).shape == (0, 1)
    assert dye_at(places, positions[:1], dye[:1], particle_radius=RADIUS) == pytest.approx(dye[0])


def write_dyed(folder: Path) -> None:
    """A ball whose dye goes from 0 on the left to 1 on the right."""
    positions, triangles = sphere((0.0, 0.0, 0.5), 0.3)
    dye = np.clip(0.5 + positions[:, :1] / 0.6, 0.0, 1.0)
    normals = (positions - (0.0, 0.0, 0.5)) / 0.3
    write_ply(folder / "milk000000.ply", positions, triangles, normals=normals, velocities=0 * positions, dye=dye)
    np.testing.assert_array_equal(read_ply(folder / "milk000000.ply").dye, dye.astype(np.float32))


@needs_bpy
def test_a_liquid_has_the_colour_of_its_dye_and_colours_mix_between(tmp_path):
    write_dyed(tmp_path)
    pictures = []
    for keys in ({}, {"dye_color": (0.7, 0.02, 0.02)}):
        material = MaterialParameters(look="milk", density=5.0, color=(0.8, 0.8, 0.8), **keys)
        milk = MeshSequenceObject(name="milk", file="milk{frame}.ply", material=material)
        (picture,) = draw_all(tmp_path, spec_of(milk, samples=16, motion_blur=False))
        pictures.append(picture)
    plain, dyed = pictures
    rows = np.s_[14:22]
    columns = [np.s_[22:25], np.s_[30:34], np.s_[39:42]]  # left, middle and right of the ball
    ratio = [
        (dyed[rows, each].mean(axis=(0, 1)) / plain[rows, each].mean(axis=(0, 1)))[1] for each in columns
    ]  # of green light
    assert ratio[0] > 0.9 > ratio[1] > ratio[2] + 0.1
    assert ratio[2] < 0.6
    red = dyed[rows, columns[2]].mean(axis=(0, 1))
    assert red[0] > 1.5 * max(red[1:])


@needs_bpy
def test_clay_jelly_and_grains_of_sand_have_the_colour_of_their_dye(tmp_path):
    """Pairs of balls, of which the second has dye all through, under one material each."""
    looks, places, radius = ("stone", "jelly", "sand"), (-0.75, -0.45, -0.15, 0.15, 0.45, 0.75), 0.14
    objects = []
    for number, x in enumerate(places):
        look, dye = looks[number // 2], float(number % 2)
        material = MaterialParameters(look=look, color=(0.6, 0.6, 0.6), dye_color=(0.7, 0.02, 0.02))
        name = f"ball{number}"
        given = {"name": name, "file": f"{name}/{{frame}}.ply", "material": material}
        (tmp_path / name).mkdir()
        positions, triangles = sphere((x, 0.0, 0.5), radius)
        if look == "sand":
            cloud = grains_of(
                positions, 0 * positions, np.arange(len(positions)), np.full(len(positions), dye), radius=0.015
            )
            write_point_cloud(tmp_path / name / "000000.ply", cloud)
            objects.append(PointSequenceObject(kind="spray", **given))
        else:
            write_ply(tmp_path / name / "000000.ply", positions, triangles, dye=np.full((len(positions), 1), dye))
            objects.append(MeshSequenceObject(**given))
    (picture,) = draw_all(tmp_path, spec_of(*objects, samples=16, motion_blur=False))
    columns = [round(RESOLUTION[0] / 2 + x * PIXELS_PER_METRE) for x in places]
    redness = [picture[16:20, at - 2 : at + 2].mean(axis=(0, 1)) for at in columns]
    without, dyed = (np.array([red / green for red, green, _ in redness[first::2]]) for first in (0, 1))
    assert (without < 1.3).all(), without
    assert (dyed > 2.0 * without).all(), (dyed, without)
