"""How thick the walls of meshes are, where geometry says it."""

import numpy as np
import pytest
import trimesh

from sim.shapes.distance_grids import local_thickness, wall_thickness
from sim.shapes.mesh_solid import solid_from_triangles


def solid_of(mesh: trimesh.Trimesh):
    return solid_from_triangles(mesh.vertices, mesh.faces, label="mesh")


def test_a_shell_is_as_thick_as_its_walls_are_apart():
    outer, inner = trimesh.creation.icosphere(3, 0.2), trimesh.creation.icosphere(3, 0.19)
    inner.invert()
    thickness = local_thickness(solid_of(trimesh.util.concatenate([outer, inner])))
    # Facets of 3 cm make walls up to 1.2 % thinner than the spheres' 10 mm; a ball fits within 10 % of its radius.
    np.testing.assert_allclose(thickness, 0.01, rtol=0.06)


def test_a_plate_is_as_thick_as_it_is_high_but_at_its_edges():
    thickness = local_thickness(solid_of(trimesh.creation.box((1.0, 0.6, 0.02))))
    assert np.median(thickness) == pytest.approx(0.02, rel=5e-3)  # 2^-14 of 0.5 m, 0.3 % of its half
    assert thickness.max() < 0.021


def test_a_ball_is_as_thick_as_its_diameter():
    thickness = local_thickness(solid_of(trimesh.creation.icosphere(3, 0.5)))
    # Half the longest edge is the largest radius that is looked for: 0.95 of the diameter, as walls are taken for flat.
    np.testing.assert_allclose(thickness, 0.95, rtol=0.01)


def test_sharp_edges_make_no_box_thin():
    """Balls that touch a box near an edge are small: a tenth of the surface is within 1/40 of the edge's length."""
    # The area within d of the edges of a face of 1 m is 4 d, and balls there have diameters up to 2 d.
    assert wall_thickness(solid_of(trimesh.creation.box((1.0, 1.0, 1.0))), 0.1) == pytest.approx(0.05, rel=0.2)
