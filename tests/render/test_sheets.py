"""Sheets and threads of particles keep whole, and surfaces enclose what their particles stand for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from test_surface import RADIUS, ball, enclosed_volume, is_closed_manifold

from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters
from render.sheets import LONGEST_IN_SPACINGS, samples_between
from render.surface import LARGEST_SHIFT_IN_RADII, reconstruct_surface

D = 2.0 * RADIUS


def film(stretch: float, jitter: float, *counts: int) -> np.ndarray:
    """A square lattice of particles (n, 3), stretched in its plane and disordered by a share of the spacing."""
    axes = [np.arange(count) for count in counts]
    places = stretch * D * np.stack(np.meshgrid(*axes, [0], indexing="ij"), axis=-1).reshape(-1, 3)
    disorder = np.random.default_rng(0).normal(0, jitter * D, places.shape) * [1.0, 1.0, 0.3]
    return (places + disorder).astype(np.float32)


def mesh_of(positions: np.ndarray, *, thin: bool, volume: float | None = None) -> SurfaceMesh:
    return reconstruct_surface(
        positions,
        np.zeros_like(positions),
        particle_radius=RADIUS,
        parameters=SurfaceParameters(),
        is_thin=np.full(len(positions), thin),
        volume=volume,
    )


def parts_and_holes(mesh: SurfaceMesh) -> tuple[int, int]:
    """Connected parts of a closed surface, and handles by Euler's number: V - E + F = 2 (parts - handles)."""
    assert is_closed_manifold(mesh)
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(mesh.vertices),) * 2)
    parts, _ = connected_components(graph, directed=False)
    euler = len(mesh.vertices) - len(edges) + len(mesh.faces)
    return parts, parts - euler // 2


@pytest.mark.parametrize(
    ("stretch", "jitter", "least", "most"), [(1.4, 0.1, 10, 0), (1.6, 0.1, 200, 0), (1.4, 0.2, 50, 3)]
)
def test_a_stretched_film_keeps_whole(stretch, jitter, least, most):
    """Without further samples it has at least, with them at most so many holes."""
    positions = film(stretch, jitter, 30, 30)
    _, before = parts_and_holes(mesh_of(positions, thin=False))
    parts, after = parts_and_holes(mesh_of(positions, thin=True))
    assert before >= least
    assert after <= most
    assert parts == 1


def test_a_stretched_thread_keeps_whole():
    positions = film(1.8, 0.1, 60, 1)
    parts, _ = parts_and_holes(mesh_of(positions, thin=False))
    assert parts > 5
    assert parts_and_holes(mesh_of(positions, thin=True)) == (1, 0)


def test_samples_lie_between_neighbours_that_are_apart():
    square = film(1.5, 0.0, 6, 6)
    pairs = samples_between(square, D)
    length = np.linalg.norm(square[pairs[:, 0]] - square[pairs[:, 1]], axis=1)
    # The sides of the cells; their diagonals, 2.12 spacings, have two corners on the ball that they span.
    sides = np.isclose(length, 1.5 * D, rtol=1e-4)
    assert sides.sum() == 60
    assert length.max() <= LONGEST_IN_SPACINGS * D
    close = film(1.0, 0.0, 6, 6)
    pairs = samples_between(close, D)
    length = np.linalg.norm(close[pairs[:, 0]] - close[pairs[:, 1]], axis=1)
    assert not np.isclose(length, D, rtol=1e-4).any()


def test_two_pieces_far_apart_are_not_joined():
    two = np.concatenate([film(1.0, 0.0, 8, 8), film(1.0, 0.0, 8, 8) + np.array([0, 0, 3 * D], np.float32)])
    assert parts_and_holes(mesh_of(two, thin=True)) == (2, 0)


@pytest.mark.parametrize(("positions", "thin"), [(ball(), False), (film(1.2, 0.2, 30, 30), True)], ids=["ball", "film"])
def test_a_surface_encloses_the_volume_of_its_particles(positions, thin):
    volume = len(positions) * D**3
    before, after = mesh_of(positions, thin=thin), mesh_of(positions, thin=thin, volume=volume)
    assert abs(enclosed_volume(before) / volume - 1.0) > 0.005
    assert enclosed_volume(after) == pytest.approx(volume, rel=1e-3)
    moved = np.linalg.norm(after.vertices.astype(float) - before.vertices, axis=1)
    assert moved.max() <= LARGEST_SHIFT_IN_RADII * RADIUS * (1 + 1e-4)
    assert is_closed_manifold(after)


def test_what_is_thin_is_moved_before_what_is_not():
    """A film beside a ball: as long as moving the film suffices, the ball stays as it is."""
    flat = film(1.2, 0.1, 30, 30) + np.array([0.2, 0.0, 0.0], np.float32)
    positions = np.concatenate([ball(), flat])
    is_thin = np.arange(len(positions)) >= len(ball())

    def mesh(volume: float | None) -> SurfaceMesh:
        return reconstruct_surface(
            positions,
            np.zeros_like(positions),
            particle_radius=RADIUS,
            parameters=SurfaceParameters(),
            is_thin=is_thin,
            volume=volume,
        )

    plain = mesh(None)
    shrunk = mesh(enclosed_volume(plain) - 0.2 * len(flat) * D**3)
    moved = np.linalg.norm(shrunk.vertices - plain.vertices, axis=1)
    of_ball = np.linalg.norm(plain.vertices, axis=1) < 0.12
    assert moved[of_ball].max() == 0.0
    assert moved[~of_ball].max() > 0.05 * RADIUS
