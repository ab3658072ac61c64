"""Where the surface of a fluid touches solids; importing it needs the bpy module, in a child process."""

from __future__ import annotations

from fresh_python import run_python
from needed_blender import needs_bpy

from pipeline.job.looks import REFRACTING_LOOKS

pytestmark = needs_bpy

SETUP = """
    import bpy
    import numpy as np
    from blender_scripts.geometry import TriangleMesh
    from blender_scripts.wetting import Solid, wetted

    REACH = 0.03

    def wet(places, normals, *solids, floor_z=-10.0):
        places, normals = (np.array(each, np.float32).reshape(-1, 3) for each in (places, normals))
        surface = TriangleMesh(places, np.zeros((0, 3), np.int32), normals)
        return wetted(surface, reach=REACH, floor_z=floor_z, solids=solids).wetness

    corners = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    box = TriangleMesh(0.1 * corners, np.concatenate([quads[:, (0, 1, 2)], quads[:, (0, 2, 3)]]).astype(np.int32))
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    sheet = TriangleMesh(square, np.array([(0, 1, 2), (0, 2, 3)], np.int32))
"""


def test_blender_and_the_pipeline_know_the_same_looks_as_clear():
    assert sorted(run_python("from blender_scripts.looks import REFRACTING; print(*REFRACTING)").split()) == sorted(
        REFRACTING_LOOKS
    )


def test_a_surface_is_wet_where_it_faces_a_body_from_near_and_where_it_dips_into_it():
    run_python(
        SETUP
        + """
    body = Solid.of(box, is_closed=True)
    gaps = np.array([-0.02, 0.0, 0.02, 0.03, 0.04, 0.06])
    towards = wet([(0.1 + gap, 0.0, 0.02) for gap in gaps], [(-1, 0, 0)] * 6, body)
    np.testing.assert_allclose(towards, [1, 1, 1, 0.5, 0, 0], atol=1e-5)
    # The outside of a film, and a free surface that ends at the body.
    assert not wet([(0.115, 0, 0.02)] * 2, [(1, 0, 0), (0, 0, 1)], body).any()
    """
    )


def test_a_body_wets_where_it_stands_and_how_it_is_turned():
    run_python(
        SETUP
        + """
    half = np.sqrt(0.5)
    turned = Solid.of(box, is_closed=True).placed((5.0, 1.0, 2.0), (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)))
    edge = 0.1 * np.sqrt(2.0)  # an edge of the box points along x when it is turned by 45 degrees about z
    here, beside = (5.0 + edge / 2 + 0.01 * half, 1.0 + edge / 2 + 0.01 * half, 2.0), (5.11, 1.11, 2.0)
    np.testing.assert_allclose(wet([here, beside], [(-half, -half, 0)] * 2, turned), [1, 0], atol=1e-5)
    """
    )


def test_cloth_is_wetted_from_both_sides_and_the_floor_from_above():
    run_python(
        SETUP
        + """
    cloth = Solid.of(sheet, is_closed=False)
    places = [(0, 0, 0.01), (0, 0, -0.01), (0, 0, 0.01)]
    np.testing.assert_allclose(wet(places, [(0, 0, -1), (0, 0, 1), (0, 0, 1)], cloth), [1, 1, 0], atol=1e-5)
    places = [(7, 7, 0.51), (7, 7, 0.49), (7, 7, 0.51), (7, 7, 0.51), (7, 7, 0.6)]
    normals = [(0, 0, -1), (0, 0, -1), (0, 0, 1), (1, 0, 0), (0, 0, -1)]
    np.testing.assert_allclose(wet(places, normals, floor_z=0.5), [1, 1, 0, 0, 0], atol=1e-5)
    """
    )


def test_a_solid_without_triangles_wets_nothing():
    run_python(
        SETUP
        + """
    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert wet([(0, 0, 0)], [(0, 0, -1)], Solid.of(nothing, is_closed=False)).tolist() == [0.0]
    """
    )


def test_what_touches_a_body_or_the_floor_can_be_moved_into_it_and_through_no_cloth():
    run_python(
        SETUP
        + """
    solids = [Solid.of(box, is_closed=True).placed((0, 0, 1), (1, 0, 0, 0)), Solid.of(sheet, is_closed=False)]
    places = np.array([(0.11, 0.02, 1.0), (3.0, 3.0, -9.99), (0.5, 0.5, 0.01), (4.0, 4.0, 4.0)], np.float32)
    normals = np.array([(-1, 0, 0), (0, 0, -1), (0, 0, -1), (0, 0, -1)], np.float32)
    surface = TriangleMesh(places, np.zeros((0, 3), np.int32), normals)
    moved = wetted(surface, reach=REACH, floor_z=-10.0, solids=solids, dips=True)
    assert moved.wetness.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert 0.09 < moved.positions[0, 0] < 0.1 and moved.positions[1, 2] < -10.0
    np.testing.assert_array_equal(moved.positions[2:], places[2:])
    kept = wetted(surface, reach=REACH, floor_z=-10.0, solids=solids)
    np.testing.assert_array_equal(kept.positions, places)
    """
    )


def test_fluids_are_wet_where_they_face_each_other_and_are_not_moved():
    run_python(
        SETUP
        + """
    other = Solid.of_fluid(box, near=TriangleMesh(np.full((1, 3), 0.1, np.float32), box.triangles), reach=REACH)
    # Right above the edges of the box, above its middle, beside it, and inside; and a film's outside.
    places = np.array([(0.1, 0.1, 0.11), (0, 0.1, 0.11), (0, 0, 0.11), (0.11, 0, 0.0), (0, 0, 0.09), (0, 0, 0.11)])
    normals = np.array([(0, 0, -1)] * 3 + [(-1, 0, 0)] + [(0, 0, -1)] + [(0, 0, 1)], np.float32)
    np.testing.assert_allclose(wet(places, normals, other), [1, 1, 1, 1, 1, 0], atol=1e-5)
    surface = TriangleMesh(places.astype(np.float32), np.zeros((0, 3), np.int32), normals)
    moved = wetted(surface, reach=REACH, floor_z=-10.0, solids=[other], dips=True)
    np.testing.assert_array_equal(moved.positions, surface.positions)
    """
    )


def test_of_another_fluid_only_what_is_near_counts():
    run_python(
        SETUP
        + """
    far = TriangleMesh(box.positions + np.float32(5.0), box.triangles)
    assert Solid.of_fluid(box, near=far, reach=REACH).tree is None
    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert Solid.of_fluid(box, near=nothing, reach=REACH).tree is None
    assert Solid.of_fluid(nothing, near=box, reach=REACH).tree is None
    """
    )
