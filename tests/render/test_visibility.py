"""What a camera sees, by geometry."""

from __future__ import annotations

import numpy as np
import pytest
from blender_scenes import sphere

from render.camera_path import View
from render.visibility import in_picture, is_inside, screen_positions

FRONT = View((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), 36.0, 2.0)  # sees a metre to each side at the origin


def test_edges_of_the_picture_are_where_the_lens_puts_them():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0.5], [1, 2, 0.0]], dtype=float)
    assert screen_positions(FRONT, points, aspect=2.0) == pytest.approx(np.array([[0, 0], [1, 0], [0, 1], [0.5, 0]]))
    assert screen_positions(FRONT, points, aspect=0.5)[1] == pytest.approx([2.0, 0.0]), "the longer side is fitted"


def test_what_lies_behind_the_camera_or_beside_the_picture_is_not_seen():
    points = np.array([[0, 0, 0], [0, -3, 0], [1.1, 0, 0], [0, 0, -0.6], [0, -2, 0]], dtype=float)
    assert in_picture(FRONT, points, aspect=2.0).tolist() == [True, False, False, False, False]


def test_a_camera_that_looks_straight_down_sees_what_is_below():
    above = View((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), 50.0, 5.0)
    assert in_picture(above, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 6.0]]), aspect=1.0).tolist() == [True, False]


def test_the_inside_of_a_mesh_is_inside_whichever_way_its_triangles_turn():
    vertices, faces = sphere((1.0, 2.0, 3.0), 0.5)
    for turned in (faces, faces[:, ::-1]):
        assert is_inside((1.0, 2.0, 3.0), vertices, turned)
        assert is_inside((1.0, 2.0, 3.4), vertices, turned)
        assert not is_inside((1.0, 2.0, 3.6), vertices, turned)
        assert not is_inside((1.4, 2.4, 3.4), vertices, turned), "in its box, not in it"
    assert not is_inside((0.0, 0.0, 0.0), np.zeros((0, 3)), np.zeros((0, 3), np.int32))
