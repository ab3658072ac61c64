"""Convex pieces of meshes: which meshes have some, and that these are the mesh."""

from __future__ import annotations

import numpy as np
import pytest

from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.convex_pieces import SAME_VOLUME, convex_pieces
from sim.shapes.mesh_solid import ConvexSolid, MeshSolid
from sim.shapes.parameters import Placement
from sim.shapes.placement import PlacedSolid, build_rest_shape

ANGLE = {
    "type": "compound",
    "part": (
        {"shape": {"type": "box", "size": (0.2, 0.1, 0.05)}},
        {"shape": {"type": "box", "size": (0.05, 0.1, 0.2)}, "position": (-0.075, 0.0, 0.125)},
    ),
}


def mesh_of(shape: dict) -> MeshSolid:
    built = build_rest_shape(Placement.model_validate({"shape": shape}).shape)
    return MeshSolid(built.surface_mesh(None))


def test_an_angle_is_two_boxes_which_stand_for_it_in_contacts():
    mesh = mesh_of(ANGLE)
    pieces = convex_pieces(mesh)
    assert len(pieces) == 2
    assert all(isinstance(piece.shape, ConvexSolid) for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(mesh.volume, rel=SAME_VOLUME)
    geometry = BodyGeometry.of(PlacedSolid(mesh, 2.0, np.eye(3), np.array([1.0, 2.0, 3.0])))
    assert len(geometry.contact_parts) == 2
    corners = np.concatenate(
        [
            part.geometry.solid.rest_mesh().vertices @ part.rotation.T
            + part.position
            - part.rotation @ part.geometry.centre_of_mass
            for part in geometry.contact_parts
        ]
    )
    assert np.stack([corners.min(axis=0), corners.max(axis=0)]) == pytest.approx(geometry.bounds, abs=1e-3)


def test_the_same_pieces_each_time():
    one, two = (convex_pieces(mesh_of(ANGLE)) for _ in range(2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first.shape.mesh.vertices, second.shape.mesh.vertices)


@pytest.mark.parametrize(
    "shape",
    [{"type": "box", "size": (0.2, 0.1, 0.05)}, {"type": "torus", "major_radius": 0.2, "minor_radius": 0.05}],
)
def test_convex_and_round_meshes_have_none(shape):
    assert convex_pieces(mesh_of(shape)) == ()


def test_distances_of_a_convex_solid_are_those_of_its_mesh():
    mesh = mesh_of({"type": "box", "size": (0.2, 0.1, 0.05)})
    points = np.random.default_rng(1).uniform(-0.15, 0.15, (300, 3))
    assert ConvexSolid(mesh.mesh).signed_distance(points) == pytest.approx(mesh.signed_distance(points), abs=1e-12)
