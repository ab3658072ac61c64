"""Primitives against closed forms: distances, volumes, bounds, meshes and placements."""

import numpy as np
import pytest
import trimesh

from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import ShapeError

PRIMITIVES = {
    "box": {"type": "box", "size": (0.3, 0.2, 0.1)},
    "sphere": {"type": "sphere", "radius": 0.25},
    "cylinder": {"type": "cylinder", "radius": 0.1, "height": 0.3},
    "capsule": {"type": "capsule", "radius": 0.1, "height": 0.2},
    "torus": {"type": "torus", "major_radius": 0.2, "minor_radius": 0.05},
    "cone": {"type": "cone", "radius": 0.1, "height": 0.2},
}
TILTED = {"position": (1.0, -2.0, 0.5), "rotation_deg": (30.0, 40.0, 50.0), "scale": 1.5}

ROUND_OFF = 1.0e-12
"""Lengths are of order 1 m and pass a dozen float64 operations."""

tilted_primitives = pytest.mark.parametrize("shape", PRIMITIVES.values(), ids=PRIMITIVES)


def points_around(solid, count=20_000, seed=0):
    lower, upper = solid.bounds
    margin = 0.3 * (upper - lower)
    return np.random.default_rng(seed).uniform(lower - margin, upper + margin, (count, 3))


@pytest.mark.parametrize(
    ("shape", "point", "distance"),
    [
        ("box", (0.25, 0.0, 0.0), 0.10),
        ("box", (0.18, 0.14, 0.0), 0.05),  # 3-4-5 from an edge
        ("box", (0.0, 0.0, 0.0), -0.05),
        ("sphere", (0.0, 0.3, 0.4), 0.25),
        ("sphere", (0.0, 0.0, 0.0), -0.25),
        ("cylinder", (0.0, 0.25, 0.0), 0.15),
        ("cylinder", (0.13, 0.0, 0.19), 0.05),  # 3-4-5 from the rim
        ("cylinder", (0.0, 0.0, 0.12), -0.03),
        ("capsule", (0.0, 0.0, 0.3), 0.10),
        ("capsule", (0.3, 0.0, 0.05), 0.20),
        ("capsule", (0.0, 0.0, 0.15), -0.05),
        ("torus", (0.0, 0.0, 0.0), 0.15),
        ("torus", (0.0, 0.2, 0.0), -0.05),
        ("torus", (0.23, 0.0, 0.04), 0.0),
        ("cone", (0.0, 0.0, 0.3), 0.2),
        ("cone", (0.0, 0.0, -0.15), 0.05),
        ("cone", (0.13, 0.0, -0.14), 0.05),  # 3-4-5 from the rim
        ("cone", (0.0, 0.0, 0.0), -0.1 * 0.1 / np.hypot(0.1, 0.2)),  # to the slant: z below the tip times sin(angle)
    ],
)
def test_distance_equals_the_value_found_by_hand(shape, point, distance):
    solid = build_solid(Placement(shape=PRIMITIVES[shape]))
    assert solid.signed_distance(np.array([point]))[0] == pytest.approx(distance, abs=ROUND_OFF)


@tilted_primitives
def test_distance_has_unit_gradient_almost_everywhere(shape):
    solid = build_solid(Placement(shape=shape, **TILTED))
    points, step = points_around(solid), 1.0e-6
    gradient = np.stack(
        [
            (solid.signed_distance(points + offset) - solid.signed_distance(points - offset)) / (2.0 * step)
            for offset in step * np.eye(3)
        ],
        axis=1,
    )
    # Differences of 1e-6 m carry 1e-9 of round-off; a point in a thousand may lie within a step of a medial axis.
    assert np.mean(np.abs(np.linalg.norm(gradient, axis=1) - 1.0) < 1.0e-6) > 0.999


@tilted_primitives
def test_distance_equals_the_way_to_its_mesh(shape):
    solid = build_solid(Placement(shape=shape, **TILTED))
    mesh = solid.surface_mesh()
    points = points_around(solid, 2000)
    _, to_mesh, _ = trimesh.proximity.closest_point_naive(trimesh.Trimesh(mesh.vertices, mesh.faces), points[:20])
    # Chords cut off at most 1.5e-4 of a radius of 0.375 m (icosphere; the others are finer).
    np.testing.assert_allclose(np.abs(solid.signed_distance(points[:20])), to_mesh, atol=1.5e-4)


@tilted_primitives
@pytest.mark.parametrize("max_edge", [None, 0.02])
def test_mesh_is_closed_outward_on_the_surface_and_of_the_right_volume(shape, max_edge):
    solid = build_solid(Placement(shape=shape, **TILTED))
    mesh = solid.surface_mesh(max_edge)
    assert mesh.is_closed
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert np.abs(solid.signed_distance(mesh.vertices)).max() < ROUND_OFF
    # Positive means outward; polygons inscribed in circles of 80 and more corners lose up to 0.13 %.
    assert mesh.signed_volume == pytest.approx(solid.volume, rel=1.5e-3)
    if max_edge is not None:
        assert np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2).max() <= max_edge


@tilted_primitives
def test_bounds_are_tight(shape):
    solid = build_solid(Placement(shape=shape, **TILTED))
    # The mesh is inscribed, within 1.5e-4 of a radius below 0.4 m.
    np.testing.assert_allclose(solid.surface_mesh().bounds, solid.bounds, atol=1.5e-4)


def test_placement_scales_then_rotates_about_world_x_y_z_then_moves():
    placement = Placement(
        shape={"type": "box", "size": (0.2, 0.4, 0.6)}, position=(1.0, 2.0, 3.0), rotation_deg=(90, 0, 90), scale=2.0
    )
    solid = build_solid(placement)
    # About x: the edge along z turns to y; then about z: that one turns to x, and x to y. y went to z.
    np.testing.assert_allclose(np.ptp(solid.bounds, axis=0), [1.2, 0.4, 0.8], atol=ROUND_OFF)
    np.testing.assert_allclose(solid.bounds.mean(axis=0), [1.0, 2.0, 3.0], atol=ROUND_OFF)
    np.testing.assert_allclose(solid.rotation @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=ROUND_OFF)


def test_orientation_is_the_quaternion_of_the_rotation():
    solid = build_solid(Placement(shape=PRIMITIVES["box"], rotation_deg=(0.0, 0.0, 90.0)))
    np.testing.assert_allclose(solid.orientation, [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=ROUND_OFF)


def test_ring_without_a_hole_is_refused_with_place_rule_value_and_remedy():
    with pytest.raises(ShapeError, match=r"minor_radius: must be less than major_radius = 0.1 m, got 0.2 m; use"):
        build_solid(Placement(shape={"type": "torus", "major_radius": 0.1, "minor_radius": 0.2}))
