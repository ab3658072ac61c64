"""What stands for a body in its equations of motion and in its contacts."""

import numpy as np
import pytest
import taichi as ti
import trimesh
from rigid_scenes import ball, body, cube

from sim.core.motion import rotation
from sim.rigid.contact_kernels import tangents_of
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


@ti.kernel
def add_tangents(axes: ti.types.ndarray(dtype=ti.f64, ndim=3)):
    for k in range(axes.shape[0]):
        one, two = tangents_of(ti.Vector([axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2]]))
        for i in ti.static(range(3)):
            axes[k, 1, i], axes[k, 2, i] = one[i], two[i]


def test_tangents_are_orthonormal_to_the_normal(taichi_cpu):
    axes = np.random.default_rng(1).normal(size=(50, 3, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    add_tangents(axes)
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
