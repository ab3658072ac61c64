"""What stands for a body in its equations of motion and in its contacts."""

import numpy as np
import pytest
import trimesh
from rigid_scenes import ball, body, cube

from sim.core.motion import rotation
from sim.rigid.contacts import Contacts, reduce_manifold, tangent_basis
from sim.shapes.body_geometry import BodyGeometry


def test_ball_has_the_inertia_of_a_ball_in_spite_of_its_facets():
    properties = BodyGeometry(body("b", ball(0.2))).mass_properties(700.0)
    mass = 700.0 * 4 / 3 * np.pi * 0.2**3
    # Facets cut a layer of even mean depth off, which scaling by the exact volume puts back to second order.
    assert properties.mass == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(properties.inertia, 0.4 * mass * 0.2**2 * np.eye(3), rtol=1e-6, atol=1e-9)


def test_ballast_adds_to_mass_and_inertia_as_a_point_mass():
    ballast = ({"mass": 3.0, "position": (0.0, 0.0, -0.2)}, {"mass": 1.0, "position": (0.1, 0.0, 0.0)})
    plain = BodyGeometry(body("b", ball(0.2))).mass_properties(500.0)
    geometry = BodyGeometry(body("b", ball(0.2), ballast=ballast))
    loaded = geometry.mass_properties(500.0)
    mass = plain.mass + 4.0
    centre = np.array([0.1, 0.0, -0.6]) / mass
    assert loaded.mass == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(geometry.centre_of_mass, centre, atol=1e-12)
    # About the shape's centre everything adds; Steiner's term takes it to the centre of mass.
    points = np.array([3.0 * 0.2**2 + 0.0, 3.0 * 0.2**2 + 1.0 * 0.1**2, 1.0 * 0.1**2])
    about_origin = plain.inertia + np.diag(points)
    steiner = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    np.testing.assert_allclose(loaded.inertia, about_origin - steiner, rtol=1e-9, atol=1e-12)


def test_cone_has_its_centre_of_mass_at_a_quarter_of_its_height():
    properties = BodyGeometry(body("c", {"type": "cone", "radius": 0.1, "height": 0.4}, scale=2.0)).mass_properties(
        300.0
    )
    np.testing.assert_allclose(properties.centre_of_mass, [0, 0, -0.2], atol=1e-9)
    # 3/10 m r² about the axis, 3/80 m (4 r² + h²) across; 160 facets are off by 1e-4 in shape.
    across = 3 / 80 * properties.mass * (4 * 0.2**2 + 0.8**2)
    expected = np.diag([across, across, 0.3 * properties.mass * 0.2**2])
    np.testing.assert_allclose(properties.inertia, expected, rtol=1e-3, atol=1e-9)


def test_mesh_with_a_hole_has_the_inertia_of_the_whole(tmp_path):
    shell = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    path = tmp_path / "shell.ply"
    trimesh.Trimesh(shell.vertices, shell.faces[shell.triangles_center[:, 2] < 0.097], process=False).export(path)
    properties = BodyGeometry(body("s", {"type": "mesh", "file": str(path)})).mass_properties(1000.0)
    mass = 1000.0 * 4 / 3 * np.pi * 0.1**3
    # Facets 0.2 %, cap 0.1 %, integration 0.1 % of the volume, and five thirds of that in inertia.
    assert properties.mass == pytest.approx(mass, rel=0.005)
    np.testing.assert_allclose(properties.inertia, 0.4 * mass * 0.01 * np.eye(3), rtol=0.017, atol=1e-5)


@pytest.mark.parametrize(
    "shape",
    [cube(0.2), {"type": "cylinder", "radius": 0.1, "height": 0.3}, {"type": "cone", "radius": 0.1, "height": 0.2}],
)
def test_balls_touch_the_surface_from_inside(shape):
    geometry = BodyGeometry(body("b", shape))
    centres, radii = geometry.balls.centres.T, geometry.balls.radii
    # A ball about a point at depth r has radius r: by construction, up to rounding.
    np.testing.assert_allclose(-geometry.signed_distance(centres), radii, atol=1e-12)
    assert radii.min() > 0.0
    assert 300 < len(radii) < 6000


def test_corner_balls_of_a_box_touch_all_three_faces():
    geometry = BodyGeometry(body("b", {"type": "box", "size": (0.3, 0.2, 0.1)}))
    centres, radii = geometry.balls.centres.T, geometry.balls.radii
    to_faces = np.array([0.15, 0.1, 0.05]) - np.abs(centres)
    corners = np.all(to_faces < 1.5 * radii[:, None], axis=1)
    assert np.count_nonzero(corners) == 8
    # Else a box would stand on feet of uneven length, and rock.
    np.testing.assert_allclose(to_faces[corners], np.repeat(radii[corners, None], 3, axis=1), rtol=1e-8)


def test_distance_grid_of_a_mesh_agrees_with_its_exact_distance(tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=3, radius=0.1).export(path)
    geometry = BodyGeometry(body("m", {"type": "mesh", "file": str(path)}))
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= 0.105 / np.linalg.norm(points, axis=1, keepdims=True)
    cell = 0.2 / 48
    # Trilinear interpolation: cell²/(4 R) for the curvature, and at the facets' edges, where the distance has a kink of
    # 8 degrees, half a cell's diagonal times the slope of half of that.
    tolerance = cell**2 / 0.4 + 0.87 * cell * np.sin(np.deg2rad(4.0))
    np.testing.assert_allclose(geometry.contact_distance(points), geometry.signed_distance(points), atol=tolerance)
    normal = geometry.contact_normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    assert np.min(np.einsum("ij,ij->i", normal, points) / 0.105) > np.cos(np.deg2rad(8.0))  # facets turn by 7°


def patch_of(points: np.ndarray, gap: np.ndarray | None = None) -> Contacts:
    """Contacts under a horizontal face; all touch unless they have gaps [m]."""
    count = len(points)
    keys = np.stack([np.zeros(count), np.ones(count), np.arange(count)], axis=1).astype(np.int64)
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Contacts(keys[:, 0], keys[:, 1], keys, points, up, np.zeros(count) if gap is None else gap)


@pytest.mark.parametrize("angle", np.linspace(0.0, np.pi / 2, 12))
def test_reduction_keeps_the_corners_of_a_square_however_it_is_turned(angle):
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9), [0.0]), axis=-1).reshape(-1, 3)
    points = rotation.rotated(rotation.exponential(np.array([0.0, 0.0, angle])), grid)
    kept = set(reduce_manifold(patch_of(points), frozenset(), margin=0.01).tolist())
    corners = set(np.flatnonzero(np.all(np.abs(grid[:, :2]) == 1.0, axis=1)).tolist())
    assert corners <= kept
    assert len(kept) <= 9


def test_reduction_prefers_the_points_of_the_last_step_among_equals():
    points = np.array([[-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
    twice = patch_of(np.concatenate([points, points]))
    last = frozenset((0, 1, feature) for feature in (4, 5, 6, 7))
    assert {4, 5, 6, 7} <= set(reduce_manifold(twice, last, margin=0.01).tolist())


def test_reduction_keeps_the_bumps_that_a_body_stands_on_and_not_a_rim_above_them():
    angle = np.arange(16) * np.pi / 8
    rim = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    feet = 0.6 * rim[[1, 6, 11]]
    gap = np.concatenate([np.full(len(rim), 0.009), [-0.001, -0.0008, -0.0009]])
    kept = set(reduce_manifold(patch_of(np.concatenate([rim, feet]), gap), frozenset(), margin=0.01).tolist())
    assert {16, 17, 18} <= kept


def test_tangents_are_orthonormal_to_the_normal():
    normals = np.random.default_rng(1).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axes = np.concatenate([normals[:, None], tangent_basis(normals)], axis=1)
    np.testing.assert_allclose(np.einsum("kia,kja->kij", axes, axes), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)


def test_quaternions_turn_like_scipys_rotations():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(2)
    vectors, points = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    expected = Rotation.from_rotvec(vectors)
    q = rotation.exponential(vectors)
    np.testing.assert_allclose(rotation.matrices(q), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation.rotated(q, points), expected.apply(points), atol=1e-14)
    product = rotation.matrices(rotation.product(q[:-1], q[1:]))
    np.testing.assert_allclose(product, (expected[:-1] * expected[1:]).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation.exponential(rotation.logarithm(q)) * np.sign(q[:, :1]), q, atol=1e-14)
