"""Where the surface of a fluid touches solids; importing it needs the bpy module, in a child process."""

from __future__ import annotations

from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy

SETUP = """
    import bpy
    import numpy as np
    from blender_scripts.ply import SurfaceMesh
    from blender_scripts.wetting import Touchable, covered, wetted

    REACH = 0.03

    def wet(places, normals, *touchables, floor_z=-10.0):
        places, normals = (np.array(each, np.float32).reshape(-1, 3) for each in (places, normals))
        surface = SurfaceMesh(places, np.zeros((0, 3), np.int32), normals)
        return wetted(surface, reach=REACH, floor_z=floor_z, touchables=touchables)[1]

    corners = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    box = SurfaceMesh(0.1 * corners, np.concatenate([quads[:, (0, 1, 2)], quads[:, (0, 2, 3)]]).astype(np.int32))
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    sheet = SurfaceMesh(square, np.array([(0, 1, 2), (0, 2, 3)], np.int32))
"""


def check(code: str, *arguments: str) -> None:
    run_python(SETUP + code, *arguments)


def test_a_surface_is_wet_where_it_faces_a_body_from_near_and_where_it_dips_into_it():
    check("""
    body = Touchable.of(box, is_closed=True)
    gaps = np.array([-0.02, 0.0, 0.02, 0.03, 0.04, 0.06])
    towards = wet([(0.1 + gap, 0.0, 0.02) for gap in gaps], [(-1, 0, 0)] * 6, body)
    np.testing.assert_allclose(towards, [1, 1, 1, 0.5, 0, 0], atol=1e-5)
    # The outside of a film, and a free surface that ends at the body.
    assert not wet([(0.115, 0, 0.02)] * 2, [(1, 0, 0), (0, 0, 1)], body).any()
    """)


def test_a_body_wets_where_it_stands_and_how_it_is_turned():
    check("""
    half = np.sqrt(0.5)
    turned = Touchable.of(box, is_closed=True).placed((5.0, 1.0, 2.0), (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)))
    edge = 0.1 * np.sqrt(2.0)  # an edge of the box points along x when it is turned by 45 degrees about z
    here, beside = (5.0 + edge / 2 + 0.01 * half, 1.0 + edge / 2 + 0.01 * half, 2.0), (5.11, 1.11, 2.0)
    np.testing.assert_allclose(wet([here, beside], [(-half, -half, 0)] * 2, turned), [1, 0], atol=1e-5)
    """)


def test_cloth_is_wetted_from_both_sides_and_the_floor_from_above():
    check("""
    cloth = Touchable.of(sheet, is_closed=False)
    places = [(0, 0, 0.01), (0, 0, -0.01), (0, 0, 0.01)]
    np.testing.assert_allclose(wet(places, [(0, 0, -1), (0, 0, 1), (0, 0, 1)], cloth), [1, 1, 0], atol=1e-5)
    gaps = (0.02, 0.03, 0.05)
    np.testing.assert_allclose(wet([(0, 0, gap) for gap in gaps], [(0, 0, -1)] * 3, cloth), [1, 0.5, 0], atol=1e-5)
    places = [(7, 7, 0.51), (7, 7, 0.49), (7, 7, 0.51), (7, 7, 0.51), (7, 7, 0.6)]
    normals = [(0, 0, -1), (0, 0, -1), (0, 0, 1), (1, 0, 0), (0, 0, -1)]
    np.testing.assert_allclose(wet(places, normals, floor_z=0.5), [1, 1, 0, 0, 0], atol=1e-5)
    """)


def test_a_solid_without_triangles_wets_nothing():
    check("""
    nothing = SurfaceMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert wet([(0, 0, 0)], [(0, 0, -1)], Touchable.of(nothing, is_closed=False)).tolist() == [0.0]
    """)


def test_what_touches_a_body_or_the_floor_can_be_moved_into_it_and_through_no_cloth():
    check("""
    body = Touchable.of(box, is_closed=True).placed((0, 0, 1), (1, 0, 0, 0))
    touchables = [body, Touchable.of(sheet, is_closed=False)]
    places = np.array([(0.11, 0.02, 1.0), (3.0, 3.0, -9.99), (0.5, 0.5, 0.01), (4.0, 4.0, 4.0)], np.float32)
    normals = np.array([(-1, 0, 0), (0, 0, -1), (0, 0, -1), (0, 0, -1)], np.float32)
    surface = SurfaceMesh(places, np.zeros((0, 3), np.int32), normals)
    moved, wetness = wetted(surface, reach=REACH, floor_z=-10.0, touchables=touchables, dips=True)
    assert wetness.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert 0.09 < moved.vertices[0, 0] < 0.1 and moved.vertices[1, 2] < -10.0
    np.testing.assert_array_equal(moved.vertices[2:], places[2:])
    kept, _ = wetted(surface, reach=REACH, floor_z=-10.0, touchables=touchables)
    np.testing.assert_array_equal(kept.vertices, places)
    """)


def test_fluids_are_wet_where_they_face_each_other_and_are_not_moved():
    check("""
    other = Touchable.of_fluid(box, near=SurfaceMesh(np.full((1, 3), 0.1, np.float32), box.faces), reach=REACH)
    # Right above the edges of the box, above its middle, beside it, and inside; and a film's outside.
    places = np.array([(0.1, 0.1, 0.11), (0, 0.1, 0.11), (0, 0, 0.11), (0.11, 0, 0.0), (0, 0, 0.09), (0, 0, 0.11)])
    normals = np.array([(0, 0, -1)] * 3 + [(-1, 0, 0)] + [(0, 0, -1)] + [(0, 0, 1)], np.float32)
    np.testing.assert_allclose(wet(places, normals, other), [1, 1, 1, 1, 1, 0], atol=1e-5)
    surface = SurfaceMesh(places.astype(np.float32), np.zeros((0, 3), np.int32), normals)
    moved, _ = wetted(surface, reach=REACH, floor_z=-10.0, touchables=[other], dips=True)
    np.testing.assert_array_equal(moved.vertices, surface.vertices)
    """)


def test_of_another_fluid_only_what_is_near_counts():
    check("""
    far = SurfaceMesh(box.vertices + np.float32(5.0), box.faces)
    assert Touchable.of_fluid(box, near=far, reach=REACH).tree is None
    nothing = SurfaceMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert Touchable.of_fluid(box, near=nothing, reach=REACH).tree is None
    assert Touchable.of_fluid(nothing, near=box, reach=REACH).tree is None
    """)


def test_beyond_a_sharp_edge_a_surface_is_outside():
    """The nearest triangle is either side of the rim, and seen from one of them what is beyond lies behind it."""
    check("""
    # Cones that point up, with rims of 45 degrees and of 27.
    turns = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    ring = np.stack([0.1 * np.cos(turns), 0.1 * np.sin(turns), np.zeros(64)], axis=1)
    first, second = np.arange(64), np.roll(np.arange(64), -1)
    middle, tip = np.full(64, 64), np.full(64, 65)
    triangles = np.concatenate([np.stack([second, first, middle], 1), np.stack([first, second, tip], 1)])
    for height in (0.1, 0.05):
        corners = np.concatenate([ring, [(0, 0, 0), (0, 0, height)]]).astype(np.float32)
        cone = Touchable.of(SurfaceMesh(corners, triangles.astype(np.int32)), is_closed=True)
        for place in (ring[5], (ring[11] + ring[12]) / 2):  # a corner of the rim, and the middle of an edge
            along = place / np.linalg.norm(place)
            for angle in np.radians([-85, -60, -30, 0, 30]):
                away = np.cos(angle) * along + np.sin(angle) * np.array([0.0, 0.0, 1.0])
                beyond = place + 0.6 * REACH * away
                np.testing.assert_allclose(wet([beyond] * 2, [-away, away], cone), [1, 0], atol=1e-5)
        # Beyond its tip, and inside of it above its base.
        above = (0.0, 0.0, height + 0.5 * REACH)
        inside = 0.97 * ring[5] + (0.0, 0.0, 0.0004)
        np.testing.assert_allclose(wet([above] * 2, [(0, 0, -1), (0, 0, 1)], cone), [1, 0], atol=1e-5)
        np.testing.assert_allclose(wet([inside] * 2, [(0, 0, 1), (0, 0, -1)], cone), [1, 0], atol=1e-5)
    """)


def test_pseudonormals_of_a_cube_weigh_its_triangles_by_their_angles():
    check("""
    from blender_scripts.sides import Pseudonormals

    # Its vertices split as for flat normals, too.
    split = Pseudonormals(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    outwards = Pseudonormals(box.vertices, box.faces)
    for number, corners in enumerate(box.vertices[box.faces]):
        face = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        face /= np.linalg.norm(face)
        third, half = np.array([1 / 3] * 3) @ corners, 0.5 * (corners[0] + corners[1])
        places = np.array([third, half, *corners])
        found = outwards.at(np.full(5, number), places)
        np.testing.assert_array_equal(split.at(np.full(5, number), places), found)
        np.testing.assert_allclose(found[0], face, atol=1e-6)
        # In the middle of a side and at its corners all faces of the cube count alike, however they are divided.
        is_diagonal = np.linalg.norm(corners[1] - corners[0]) > 0.25
        expected = face if is_diagonal else half * (np.abs(half) > 0.05) / np.linalg.norm(half)
        np.testing.assert_allclose(found[1], expected, atol=1e-6)
        np.testing.assert_allclose(found[2:], corners / np.linalg.norm(corners, axis=1)[:, None], atol=1e-6)
    """)


def test_a_liquid_covers_a_wall_up_to_its_level_and_across_the_sliver_beside_it():
    check("""
    # The box as liquid, 0.2 m wide, whose side ends 1 cm short of a wall; a particle's radius is 2 cm.
    heights = np.array([-0.05, 0.0, 0.05, 0.09, 0.099, 0.101, 0.11, 0.15])
    wall = np.stack([np.full(8, 0.11), np.zeros(8), heights], axis=1)
    inwards = np.tile((-1.0, 0.0, 0.0), (8, 1))
    share = covered(wall, inwards, surface=box, reach=REACH)
    assert ((share > 0.5) == (heights < 0.1)).all()
    np.testing.assert_allclose(share[[0, 1, 2, 7]], [1, 1, 1, 0], atol=1e-5)
    # Its outer side, and a wall that the liquid is two radii away from.
    assert not covered(wall, -inwards, surface=box, reach=REACH).any()
    assert (covered(wall + (0.03, 0, 0), inwards, surface=box, reach=REACH) < 0.5).all()
    """)


def test_what_is_in_the_middle_of_no_liquid_is_not_covered():
    check("""
    empty = SurfaceMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert covered(np.zeros((2, 3)), np.ones((2, 3)), surface=empty, reach=REACH).tolist() == [0.0, 0.0]
    """)
