"""Droplets: parts of a few particles are drawn finer, and nothing else is touched."""

from __future__ import annotations

import numpy as np
import pytest

from render.droplets import DROPLET_PARTICLES, connected_parts, shrink_droplets
from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters
from render.surface import reconstruct_surface

RADIUS = 0.005
AS_THEY_ARE = SurfaceParameters(droplet_size=1.0)


def mesh_of(positions, parameters: SurfaceParameters) -> SurfaceMesh:
    rows = np.asarray(positions, np.float32)
    return reconstruct_surface(rows, rows, particle_radius=RADIUS, parameters=parameters)


def lattice(*counts: int) -> np.ndarray:
    axes = [np.arange(count) for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2 * RADIUS


def width(mesh: SurfaceMesh) -> float:
    return float(np.ptp(mesh.vertices, axis=0).max())


@pytest.mark.parametrize("size", [0.25, 0.5])
def test_a_droplet_of_one_particle_has_that_share_of_its_width_about_the_same_middle(size):
    particle = np.array([[0.2, -0.1, 0.3]])
    whole, small = mesh_of(particle, AS_THEY_ARE), mesh_of(particle, SurfaceParameters(droplet_size=size))
    assert width(small) == pytest.approx(size * width(whole), rel=1e-5)  # float32
    np.testing.assert_allclose(small.vertices.mean(axis=0), whole.vertices.mean(axis=0), atol=1e-7)


def test_more_particles_shrink_less_and_eight_keep_their_size():
    clusters = [lattice(1, 1, 1), lattice(2, 1, 1), lattice(2, 2, 1), lattice(2, 2, 2)]
    parameters = SurfaceParameters(droplet_size=0.5)
    shares = [width(mesh_of(cluster, parameters)) / width(mesh_of(cluster, AS_THEY_ARE)) for cluster in clusters]
    expected = [0.5 + 0.5 * (len(cluster) - 1) / (DROPLET_PARTICLES - 1) for cluster in clusters]
    assert expected[-1] == 1.0
    assert shares == pytest.approx(expected, rel=1e-5)  # float32


def test_a_body_of_water_beside_droplets_keeps_its_vertices():
    body, droplet = lattice(12, 12, 12), np.array([[0.3, 0.3, 0.3]])
    both = np.concatenate([body, droplet])
    whole, small = mesh_of(both, AS_THEY_ARE), mesh_of(both, SurfaceParameters())
    part, volumes = connected_parts(whole)
    assert len(volumes) == 2
    of_body = part == np.argmax(volumes)
    np.testing.assert_array_equal(small.vertices[of_body], whole.vertices[of_body])
    assert not np.array_equal(small.vertices[~of_body], whole.vertices[~of_body])


def test_only_positions_change():
    positions = np.concatenate([lattice(4, 4, 4), [[0.2, 0.2, 0.2]]])
    whole, small = mesh_of(positions, AS_THEY_ARE), mesh_of(positions, SurfaceParameters())
    for name in ("faces", "normals", "velocities"):
        np.testing.assert_array_equal(getattr(small, name), getattr(whole, name))


def test_a_cavity_stays_as_it_is():
    corners = RADIUS * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    inwards = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
    cavity = SurfaceMesh(corners, inwards)
    droplet = SurfaceMesh(corners, inwards[:, ::-1].copy())
    particle = corners[:1]
    assert shrink_droplets(cavity, particle, particle_radius=RADIUS, size=0.5) is cavity
    shrunk = shrink_droplets(droplet, particle, particle_radius=RADIUS, size=0.5)
    assert width(shrunk) == pytest.approx(0.5 * width(droplet))
