"""Fluid surfaces: closed, as large as the fluid, carried by its velocity, and the same every time."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from fresh_python import run_python
from places import HELPERS

from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters
from render.surface import SurfaceReconstructionError, reconstruct_surface, without_collapsed_parts

RADIUS = 0.005
BALL_RADIUS = 0.1
HERE = f"""
import sys
sys.path[:0] = [{str(HELPERS)!r}, {str(Path(__file__).parent)!r}]
from test_surface import *
"""
"""Begins code for another process with what this module has."""
PARAMETERS = SurfaceParameters()


def ball(center=(0.0, 0.0, 0.0), radius=BALL_RADIUS) -> np.ndarray:
    """Particles at rest: a lattice of two particle radii, cut by a sphere."""
    count = int(radius / (2 * RADIUS)) + 1
    axis = (np.arange(-count, count) + 0.5) * 2 * RADIUS
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return (lattice[np.linalg.norm(lattice, axis=1) < radius] + center).astype(np.float32)


def splash() -> np.ndarray:
    """A ball and a spray of single particles far from it and from each other."""
    axis = np.arange(-0.3, 0.31, 0.15)
    spray = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.concatenate([ball(), spray[np.linalg.norm(spray, axis=1) > 0.14]]).astype(np.float32)


def mesh_of(positions, velocities=None, parameters=PARAMETERS) -> SurfaceMesh:
    velocities = np.zeros_like(positions) if velocities is None else velocities
    return reconstruct_surface(positions, velocities, particle_radius=RADIUS, parameters=parameters)


def enclosed_volume(mesh: SurfaceMesh) -> float:
    """Divergence theorem over the triangles; positive when they face outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def is_closed_manifold(mesh: SurfaceMesh) -> bool:
    """Every directed edge occurs once, and so does its reverse."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).astype(np.int64)
    keys, reversed_keys = edges @ [1 << 32, 1], edges @ [1, 1 << 32]
    return len(np.unique(keys)) == len(keys) and np.array_equal(np.sort(keys), np.sort(reversed_keys))


def digest(mesh: SurfaceMesh) -> str:
    arrays = (mesh.vertices, mesh.faces, mesh.normals, mesh.velocities)
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def test_a_ball_keeps_its_volume():
    volume = enclosed_volume(mesh_of(ball()))
    # The contour of the density lies within a tenth of a particle radius of the lattice's edge: 3 * 0.1 r / R = 1.5 %;
    # a cell of 0.75 r cuts the curvature for another 0.5 %, and the smoothing for as much.
    assert volume == pytest.approx(4 / 3 * np.pi * BALL_RADIUS**3, rel=0.03)


def test_the_surface_is_closed_and_of_the_types_of_the_files():
    mesh = mesh_of(splash())
    assert is_closed_manifold(mesh)
    assert mesh.vertices.dtype == mesh.normals.dtype == mesh.velocities.dtype == np.float32
    assert mesh.faces.dtype == np.int32
    assert mesh.vertices.shape == mesh.normals.shape == mesh.velocities.shape
    assert mesh.faces.max() == len(mesh.vertices) - 1  # no vertex without a face


def test_normals_are_of_unit_length_and_point_out():
    mesh = mesh_of(ball())
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)  # float32
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    # The lattice's steps show: a step of half a spacing over one is what they could tilt at most; smoothing leaves 4°.
    assert np.einsum("ij,ij->i", mesh.normals, outward).min() > np.cos(np.radians(10))


def test_a_uniform_velocity_is_carried_exactly():
    positions = splash()
    velocity = np.array([1.5, -2.0, 0.25], np.float32)
    mesh = mesh_of(positions, np.broadcast_to(velocity, positions.shape))
    # A weighted mean of equal numbers, in float32.
    np.testing.assert_allclose(mesh.velocities, np.broadcast_to(velocity, mesh.velocities.shape), rtol=1e-5)


def test_a_linear_velocity_is_carried_to_within_two_particle_radii():
    gradient = np.array([[1, 2, 0], [0, -1, 3], [0.5, 0, 1]], np.float32)
    positions = ball()
    mesh = mesh_of(positions, positions @ gradient.T)
    error = np.linalg.norm(mesh.velocities - mesh.vertices @ gradient.T, axis=1)
    # The mean over the particles within 4 r lies inside the fluid, by less than half of their reach.
    assert error.max() < np.linalg.norm(gradient, ord=2) * 2 * RADIUS


def test_a_single_particle_is_a_small_round_drop():
    mesh = mesh_of(np.array([[0.2, -0.1, 0.3]], np.float32))
    assert is_closed_manifold(mesh)
    distance = np.linalg.norm(mesh.vertices - [0.2, -0.1, 0.3], axis=1)
    # As large as a particle and round to half a cell of 0.75 r.
    assert 0.8 * RADIUS < distance.min() <= distance.max() < 1.6 * RADIUS
    assert np.ptp(distance) < 0.375 * RADIUS


def test_spray_does_not_grow_with_smoothing():
    """The weights of the smoothing spare isolated particles (Löschner et al. 2023, section 3)."""
    particle = np.zeros((1, 3), np.float32)
    raw = mesh_of(particle, parameters=SurfaceParameters(mesh_smoothing_iterations=0))
    smooth = mesh_of(particle, parameters=SurfaceParameters(mesh_smoothing_iterations=25))
    # Unweighted, 25 passes would shrink the drop to a point.
    assert enclosed_volume(smooth) == pytest.approx(enclosed_volume(raw), rel=0.05)


def test_no_particles_give_a_mesh_without_vertices():
    mesh = mesh_of(np.empty((0, 3), np.float32))
    assert mesh.vertices.shape == mesh.faces.shape == mesh.normals.shape == mesh.velocities.shape == (0, 3)


def test_the_same_particles_give_the_same_bytes_in_every_process():
    positions = splash()
    told = run_python(HERE + "print(digest(mesh_of(splash(), splash())))")
    digests = {digest(mesh_of(positions, positions)) for _ in range(4)}
    assert digests == {told.strip()}


def test_a_process_keeps_its_number_of_threads():
    mesh_of(ball(radius=0.03))
    with pytest.raises(ValueError, match="this process meshes with 1 threads since its first surface, got 2"):
        reconstruct_surface(ball(), ball(), particle_radius=RADIUS, parameters=PARAMETERS, threads=2)


def test_several_threads_give_the_same_surface_up_to_order_and_rounding():
    script = """
mesh = reconstruct_surface(splash(), splash(), particle_radius=RADIUS, parameters=PARAMETERS, threads=2)
print(enclosed_volume(mesh), is_closed_manifold(mesh), len(mesh.vertices))
"""
    volume, closed, vertex_count = run_python(HERE + script).split()
    mesh = mesh_of(splash())
    assert float(volume) == pytest.approx(enclosed_volume(mesh), rel=1e-4)  # order of summation and of collapses
    assert closed == "True"
    assert int(vertex_count) == pytest.approx(len(mesh.vertices), rel=1e-3)


@pytest.mark.parametrize("array", ["positions", "velocities"])
def test_particles_that_are_not_finite_are_refused_by_number(array):
    arrays = {"positions": ball(), "velocities": ball()}
    arrays[array][17, 2] = np.nan
    with pytest.raises(SurfaceReconstructionError, match=f"{array} of particle 17 are not finite"):
        mesh_of(**arrays)


def test_arrays_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match="every particle needs a velocity"):
        mesh_of(ball(), ball()[:-1])
    with pytest.raises(ValueError, match=r"positions must have the shape \(n, 3\), got \(4, 2\)"):
        mesh_of(np.zeros((4, 2)), np.zeros((4, 2)))


TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def surface_of(vertices, faces, undefined) -> SurfaceMesh:
    normals = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    normals[list(undefined)] = np.nan
    velocities = np.arange(3 * len(vertices), dtype=np.float32).reshape(-1, 3)
    return SurfaceMesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32), normals, velocities)


def test_a_part_collapsed_to_two_triangles_back_to_back_is_dropped():
    flat = np.array([[5, 5, 5], [6, 5, 5], [5, 6, 5]], np.float32)
    whole = surface_of(
        np.concatenate([flat, TETRAHEDRON]), np.concatenate([[[0, 1, 2], [2, 1, 0]], TETRAHEDRON_FACES + 3]), {0, 1, 2}
    )
    cleaned = without_collapsed_parts(whole)
    np.testing.assert_array_equal(cleaned.vertices, TETRAHEDRON)
    np.testing.assert_array_equal(cleaned.faces, TETRAHEDRON_FACES)
    np.testing.assert_array_equal(cleaned.velocities, whole.velocities[3:])
    assert np.isfinite(cleaned.normals).all()


def test_a_vertex_without_a_normal_takes_the_mean_of_its_triangles():
    cleaned = without_collapsed_parts(surface_of(TETRAHEDRON, TETRAHEDRON_FACES, {0}))
    np.testing.assert_array_equal(cleaned.faces, TETRAHEDRON_FACES)
    # The corner at the origin of three equal right triangles: the diagonal, pointing out, to float32 rounding.
    np.testing.assert_allclose(cleaned.normals[0], -np.ones(3) / np.sqrt(3), atol=1e-6)


def test_a_surface_whose_normals_are_all_defined_is_left_alone():
    whole = surface_of(TETRAHEDRON, TETRAHEDRON_FACES, ())
    assert without_collapsed_parts(whole) is whole
