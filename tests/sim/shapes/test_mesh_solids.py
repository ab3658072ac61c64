"""The inside of meshes: closed, holed, inverted, overlapping, hollow; and those that have none."""

import numpy as np
import pytest
import trimesh

from sim.shapes.mass_properties import integrate_moments
from sim.shapes.mesh_solid import boundary_edges, boundary_loops, cap_holes, solid_from_triangles
from sim.shapes.solid import ShapeError

SPHERE = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
VERTICES, FACES = np.array(SPHERE.vertices), np.array(SPHERE.faces)
FACET_HEIGHT = 2.5e-3
"""How far the faces of this icosphere cut below the unit sphere at most."""


def faces_below(z):
    return FACES[VERTICES[FACES].mean(axis=1)[:, 2] < z]


def probes(count=4000):
    return np.random.default_rng(3).uniform(-1.4, 1.4, (count, 3))


def wavy_sheet():
    u, v = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21), indexing="ij")
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack([u, v, 0.1 * np.sin(6.0 * u)], axis=-1).reshape(-1, 3), faces


def test_closed_mesh_has_the_distance_of_the_sphere_it_approximates():
    solid = solid_from_triangles(VERTICES, FACES, label="ball")
    exact = np.linalg.norm(probes(), axis=1) - 1.0
    np.testing.assert_allclose(solid.signed_distance(probes()), exact, atol=FACET_HEIGHT)
    assert solid.warnings == ()
    assert solid.volume == pytest.approx(SPHERE.volume, rel=1e-12)


def test_mesh_with_a_hole_keeps_its_inside_and_says_so():
    solid = solid_from_triangles(VERTICES, faces_below(0.95), label="ball.obj")
    points = probes()
    # The hole takes the cap above z = 0.93; elsewhere the inside is that of the ball.
    away_from_hole = (points[:, 2] < 0.9) & (np.abs(np.linalg.norm(points, axis=1) - 1.0) > FACET_HEIGHT)
    inside = solid.signed_distance(points) < 0.0
    np.testing.assert_array_equal(inside[away_from_hole], (np.linalg.norm(points, axis=1) < 1.0)[away_from_hole])
    assert not inside[points[:, 2] > 1.0].any()
    assert solid.mesh.is_closed
    (warning,) = solid.warnings
    assert warning.startswith("ball.obj has a hole (32 boundary edges); its inside is taken from the generalized wind")


def test_distance_across_a_hole_is_that_to_its_cap():
    solid = solid_from_triangles(VERTICES, faces_below(0.95), label="ball")
    axis = np.stack([np.zeros(21), np.zeros(21), np.linspace(0.8, 1.1, 21)], axis=1)
    rim = np.unique(boundary_edges(faces_below(0.95)))
    z_of_cap = VERTICES[rim, 2].mean()
    # The rim zigzags by 0.02, and so may the surface on which the winding number is 1/2.
    np.testing.assert_allclose(solid.signed_distance(axis), axis[:, 2] - z_of_cap, atol=0.02)


def test_several_holes_are_counted_and_capped():
    x, _, z = VERTICES[FACES].mean(axis=1).T
    solid = solid_from_triangles(VERTICES, FACES[(z < 0.97) & (z > -0.97) & (x < 0.97)], label="ball")
    assert "ball has 3 holes" in solid.warnings[0]
    assert solid.mesh.is_closed
    assert solid.volume == pytest.approx(SPHERE.volume, rel=0.01)  # three caps of height 0.03..0.04 take 0.4 %


def test_split_vertices_are_no_holes():
    soup = VERTICES[FACES].reshape(-1, 3).astype(np.float32)
    solid = solid_from_triangles(soup, np.arange(len(soup)).reshape(-1, 3), label="ball")
    assert solid.warnings == ()
    assert solid.volume == pytest.approx(SPHERE.volume, rel=1e-6)  # float32 vertices


def test_inside_out_mesh_is_turned_with_a_warning():
    solid = solid_from_triangles(VERTICES, FACES[:, ::-1], label="ball")
    assert solid.signed_distance(np.zeros((1, 3)))[0] == pytest.approx(-1.0, abs=FACET_HEIGHT)
    assert solid.mesh.signed_volume > 0.0
    assert solid.warnings == ("ball was inside out; all of its 5120 faces were turned",)


def test_inside_out_mesh_with_a_hole_is_turned_too():
    solid = solid_from_triangles(VERTICES, faces_below(0.95)[:, ::-1], label="ball")
    assert solid.signed_distance(np.zeros((1, 3)))[0] < -0.9
    assert "was inside out" in solid.warnings[0]


def test_faces_that_disagree_with_their_neighbours_are_turned():
    faces = FACES.copy()
    faces[::3] = faces[::3, ::-1]
    solid = solid_from_triangles(VERTICES, faces, label="ball")
    assert solid.volume == pytest.approx(SPHERE.volume, rel=1e-12)
    assert solid.warnings == ("1707 of the 5120 faces of ball pointed the wrong way and were turned",)


def test_inverted_part_beside_a_sound_one_is_turned():
    vertices = np.concatenate([VERTICES, 0.5 * VERTICES + np.array([3.0, 0.0, 0.0])])
    solid = solid_from_triangles(vertices, np.concatenate([FACES, FACES[:, ::-1] + len(VERTICES)]), label="balls")
    centres = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(solid.signed_distance(centres), [-1.0, -0.5], atol=FACET_HEIGHT)
    assert solid.volume == pytest.approx(1.125 * SPHERE.volume, rel=1e-12)


def test_inverted_part_that_reaches_into_a_sound_one_is_no_cavity():
    vertices = np.concatenate([VERTICES, 0.3 * VERTICES + np.array([0.0, 0.0, 1.0])])
    solid = solid_from_triangles(vertices, np.concatenate([FACES, FACES[:, ::-1] + len(VERTICES)]), label="balls")
    assert np.all(solid.signed_distance(np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 1.2]])) < 0.0)


def test_cavity_stays_outside():
    vertices = np.concatenate([VERTICES, 0.5 * VERTICES])
    solid = solid_from_triangles(vertices, np.concatenate([FACES, FACES[:, ::-1] + len(VERTICES)]), label="shell")
    points = np.array([[0.0, 0.0, 0.0], [0.75, 0.0, 0.0], [1.5, 0.0, 0.0]])
    np.testing.assert_allclose(solid.signed_distance(points), [0.5, -0.25, 0.5], atol=FACET_HEIGHT)
    assert solid.volume == pytest.approx(0.875 * SPHERE.volume, rel=1e-12)
    assert solid.warnings == ()


def test_overlapping_parts_unite():
    vertices = np.concatenate([VERTICES, VERTICES + np.array([1.0, 0.0, 0.0])])
    solid = solid_from_triangles(vertices, np.concatenate([FACES, FACES + len(VERTICES)]), label="twins")
    # On the axis the buried walls at x = 0 and x = 1 are no surface: the nearest one is the seam, or an outer wall.
    points = np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    to_seam = np.sqrt(0.75)
    # Beside the seam, triangles of edge 0.07 that cross it still count.
    np.testing.assert_allclose(solid.signed_distance(points), [-to_seam, -1.0, -1.0, -0.5], atol=0.07)
    assert solid.warnings == ("twins has parts that overlap; they are united",)
    lens = np.pi * 5.0 / 12.0  # of two unit balls at distance 1
    assert solid.volume == pytest.approx(8.0 / 3.0 * np.pi - lens, rel=5e-3)  # facets 0.2 %, grid 0.3 %


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        pytest.param(*wavy_sheet(), id="open sheet"),
        pytest.param(wavy_sheet()[0], np.concatenate([wavy_sheet()[1], wavy_sheet()[1][:, ::-1]]), id="both sides"),
        pytest.param(VERTICES, faces_below(0.0), id="hemisphere without a base"),
        pytest.param(VERTICES, FACES[VERTICES[FACES].mean(axis=1)[:, 2] ** 2 < 0.25], id="tube without ends"),
    ],
)
def test_mesh_without_a_clear_inside_is_refused(vertices, faces):
    with pytest.raises(ShapeError, match=r"thing.obj has no clear inside: .*(at most 20 % may be).*; \w+"):
        solid_from_triangles(vertices, faces, label="thing.obj")


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], "is flat: its extent is 1 x 1 x 0 m; "),
        (np.ones((3, 3)), [[0, 1, 2]], "has no extent: all of its vertices are in one place"),
        (
            np.where(np.arange(len(VERTICES))[:, None] < 2, np.nan, VERTICES),
            FACES,
            "has 2 vertices that are not finite",
        ),
    ],
    ids=["flat", "collapsed", "not finite"],
)
def test_mesh_that_encloses_nothing_is_refused(vertices, faces, message):
    with pytest.raises(ShapeError, match=f"thing {message}"):
        solid_from_triangles(vertices, faces, label="thing")


def test_loops_meeting_in_one_vertex_are_told_apart_and_capped():
    around_vertex = np.flatnonzero((FACES == 0).any(axis=1))
    removed = around_vertex[[0, 2]]  # two faces that share vertex 0 only
    faces = np.delete(FACES, removed, axis=0)
    loops = boundary_loops(faces)
    assert sorted(len(loop) for loop in loops) == [3, 3]
    _, caps = cap_holes(VERTICES, faces, loops)
    assert len(boundary_edges(np.concatenate([faces, caps]))) == 0


def test_moments_converge_with_second_order():
    solid = solid_from_triangles(VERTICES, FACES, label="ball")
    errors = [abs(integrate_moments(solid, cells=cells).volume / SPHERE.volume - 1.0) for cells in (12, 96)]
    # Eight times the cells: 64 at second order, 8 at first. How the lattice meets the surface moves single errors by 2.
    assert errors[1] < errors[0] / 20.0
    assert errors[1] < 5e-4
