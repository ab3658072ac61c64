"""Bodies of revolution against closed forms, primitives and their own meshes."""

import numpy as np
import pytest

from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.distance_grids import sampled_distances
from sim.shapes.parameters import Placement, WeightedPlacement
from sim.shapes.placement import build_solid
from sim.shapes.primitives import Cone, Cylinder
from sim.shapes.solid import ShapeError

ROUND_OFF = 1.0e-12
CUP = [(0.0, 0.0), (0.05, 0.0), (0.05, 0.1), (0.047, 0.1), (0.047, 0.003), (0.0, 0.003)]
"""Radius 5 cm, 10 cm high, walls and bottom of 3 mm; its middle is 5 cm above its bottom."""


def revolved(profile, **placed):
    return build_solid(Placement(shape={"type": "revolved", "profile": profile}, **placed))


def points_around(solid, count=5000):
    lower, upper = solid.bounds
    return np.random.default_rng(0).uniform(lower - 0.02, upper + 0.02, (count, 3))


@pytest.mark.parametrize(
    ("profile", "same"),
    [
        ([(0.0, -0.1), (0.06, -0.1), (0.06, 0.1), (0.0, 0.1)], Cylinder(0.06, 0.2)),
        ([(0.0, 0.2), (0.1, 0.0), (0.0, 0.0)], Cone(0.1, 0.2)),  # from the tip, and anywhere on z
    ],
)
def test_it_is_the_primitive_of_the_same_profile(profile, same):
    solid = revolved(profile)
    points = points_around(solid)
    np.testing.assert_allclose(solid.signed_distance(points), same.signed_distance(points), atol=ROUND_OFF)
    assert solid.volume == pytest.approx(same.volume, rel=1e-12)
    directions = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(solid.shape.support(directions), same.support(directions), atol=ROUND_OFF)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.0, 0.0, 0.0), 0.047),  # in the cup, from all of its wall
        ((0.0, 0.0, -0.0485), -0.0015),  # in the middle of the bottom
        ((0.0485, 0.0, 0.02), -0.0015),
        ((0.0, 0.053, 0.054), 0.005),  # 3-4-5 from the rim
        ((0.0, 0.0, -0.06), 0.01),
    ],
)
def test_distances_of_a_cup_found_by_hand(point, distance):
    assert revolved(CUP).signed_distance(np.array([point]))[0] == pytest.approx(distance, abs=ROUND_OFF)


@pytest.mark.parametrize("profile", [CUP, [(0.03, 0.0), (0.05, 0.0), (0.04, 0.05)]], ids=["cup", "ring"])
def test_the_mesh_is_closed_fine_and_holds_the_volume(profile):
    solid = revolved(profile, scale=2.0, rotation_deg=(10.0, 20.0, 0.0), position=(1.0, 0.0, 0.0))
    mesh = solid.surface_mesh(0.004)
    assert mesh.is_closed
    # 160 chords of a circle leave (2 pi / 160)² / 6 of its area out.
    assert mesh.signed_volume == pytest.approx(solid.volume, rel=1e-3)
    sides = mesh.corners - np.roll(mesh.corners, 1, axis=1)
    assert np.linalg.norm(sides, axis=2).max() < 0.004 * (1 + 1e-9)
    np.testing.assert_allclose(solid.signed_distance(mesh.vertices), 0.0, atol=ROUND_OFF)


def test_the_mass_of_a_cup_that_moves_is_that_of_its_wall():
    body = WeightedPlacement(shape={"type": "revolved", "profile": CUP})
    properties = BodyGeometry(body).mass_properties(2500.0)
    wall = np.pi * 0.1 * (0.05**2 - 0.047**2) + np.pi * 0.047**2 * 0.003
    assert properties.mass == pytest.approx(2500.0 * wall, rel=5e-3)


def test_the_grid_of_a_cup_is_as_fine_as_its_wall_needs():
    grid = sampled_distances(revolved(CUP))
    assert grid.spacing == pytest.approx(0.001, rel=0.1)  # 96 cells along the longest edge
    thin = [(r if r < 0.047 else max(r, 0.0486), z) for r, z in CUP]
    assert sampled_distances(revolved(thin)).spacing == pytest.approx(0.0007, rel=0.1)


@pytest.mark.parametrize(
    ("profile", "rule"),
    [
        ([(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1), (0.0, 0.2)], "point 3 of 5 is on the axis"),
        ([(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)], "last point is not"),
        ([(0.0, 0.0), (0.1, 0.1), (0.1, 0.0), (0.0, 0.1)], "crosses itself"),
        ([(0.0, 0.0), (0.1, 0.0), (0.1, 0.0), (0.0, 0.1)], "point 2 is there twice"),
        ([(0.1, 0.0), (0.2, 0.0), (0.3, 0.0)], "encloses no area"),
    ],
)
def test_what_is_no_region_is_refused(profile, rule):
    with pytest.raises(ShapeError, match=rule):
        revolved(profile)
