"""Mass properties of rigid bodies, and static bodies."""

import numpy as np
import pytest
import trimesh

from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.states import StaticBody
from sim.shapes.mass_properties import mass_properties_of_mesh, mass_properties_of_solid
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import TriangleMesh

DENSITY = 700.0


def test_box_has_the_inertia_of_a_box():
    a, b, c = 0.3, 0.2, 0.1
    solid = build_solid(Placement(shape={"type": "box", "size": (a, b, c)}))
    properties = mass_properties_of_mesh(solid.surface_mesh(), DENSITY)
    expected = properties.mass / 12.0 * np.diag([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    np.testing.assert_allclose(properties.inertia, expected, rtol=1e-12, atol=1e-15)
    assert properties.mass == pytest.approx(DENSITY * a * b * c, rel=1e-12)


def test_inertia_of_an_off_centre_tilted_mesh_follows_the_rotation():
    placement = {"position": (3.0, -2.0, 5.0), "rotation_deg": (20.0, 50.0, -70.0)}
    solid = build_solid(Placement(shape={"type": "box", "size": (0.3, 0.2, 0.1)}, **placement))
    properties = mass_properties_of_mesh(solid.surface_mesh(), DENSITY)
    at_rest = mass_properties_of_mesh(solid.rest_mesh(), DENSITY)
    # Volume integrals about the world's origin cancel to (0.1 m / 6 m)² of themselves: 1e-12 of what remains.
    np.testing.assert_allclose(properties.centre_of_mass, placement["position"], rtol=1e-10)
    turned = solid.rotation @ at_rest.inertia @ solid.rotation.T
    np.testing.assert_allclose(properties.inertia, turned, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder"])
def test_integration_over_the_distance_agrees_with_the_mesh(shape):
    sizes = {"sphere": {"radius": 0.2}, "box": {"size": (0.3, 0.2, 0.1)}, "cylinder": {"radius": 0.1, "height": 0.3}}
    solid = build_solid(
        Placement(shape={"type": shape, **sizes[shape]}, position=(0.5, 0.1, -0.2), rotation_deg=(10.0, 20.0, 30.0))
    )
    of_mesh = mass_properties_of_mesh(solid.surface_mesh(), DENSITY)
    of_solid = mass_properties_of_solid(solid, DENSITY)
    # 64 cells along the longest edge: second order in 1/64, and edges of the box are rounded by half a cell.
    assert of_solid.mass == pytest.approx(of_mesh.mass, rel=5e-3)
    np.testing.assert_allclose(of_solid.centre_of_mass, of_mesh.centre_of_mass, atol=1e-4)
    np.testing.assert_allclose(of_solid.inertia, of_mesh.inertia, atol=7e-3 * np.trace(of_mesh.inertia))


def test_open_or_inverted_mesh_is_refused():
    mesh = build_solid(Placement(shape={"type": "box", "size": (1.0, 1.0, 1.0)})).surface_mesh()
    for broken in (mesh.faces[1:], mesh.faces[:, ::-1]):
        with pytest.raises(ValueError, match="closed mesh with outward normals"):
            mass_properties_of_mesh(TriangleMesh(mesh.vertices, broken), DENSITY)


def static_duck():
    return StaticBody(
        RigidBodyParameters(
            name="duck",
            shape={"type": "duck", "length": 0.1},
            position=(0.3, 0.2, 0.1),
            rotation_deg=(0.0, 20.0, 90.0),
            scale=2.0,
        )
    )


def test_pose_of_the_snapshot_puts_the_rest_mesh_where_the_solid_is():
    body = static_duck()
    snapshot = body.snapshot()
    assert snapshot.kind == "rigid"
    assert all(array.dtype == np.float64 for array in snapshot.arrays.values())
    w, x, y, z = snapshot.arrays["orientation"]
    rotation = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    placed = body.solid.rest_mesh().vertices @ rotation.T + snapshot.arrays["position"]
    np.testing.assert_allclose(placed, body.solid.surface_mesh().vertices, atol=1e-12)
    assert not snapshot.arrays["velocity"].any()
    assert not snapshot.arrays["angular_velocity"].any()


def test_samples_lie_on_the_placed_surface():
    body = static_duck()
    samples = body.solid.surface_samples(0.01)
    assert samples.dtype == np.float32
    assert len(samples) > 500
    # Samples are points of the mesh's triangles, rounded to float32 at half a metre.
    np.testing.assert_allclose(body.solid.signed_distance(samples), 0.0, atol=1e-6)
