"""Fluid surfaces: particles become a closed triangle mesh that carries their velocity.

The density of the particles is sampled on a grid and contoured by marching cubes, the contour's slivers are collapsed
(Moore & Warren 1992), and a Laplacian smoothing that spares isolated droplets removes the particles' bumps (Löschner,
Böttcher, Jeske & Bender 2023, "Weighted Laplacian Smoothing for Surface Reconstruction of Particle-based Fluids").
splashsurf does the work; droplets of a few particles are then drawn finer than they came out (`render.droplets`).
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.droplets import shrink_droplets
from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters


class SurfaceReconstructionError(Exception):
    """Particles could not be meshed; says why."""


def reconstruct_surface(
    positions: ArrayLike,
    velocities: ArrayLike,
    *,
    particle_radius: float,
    parameters: SurfaceParameters,
    threads: int = 1,
) -> SurfaceMesh:
    """Mesh the surface of a fluid.

    One thread gives the same bytes for the same particles, in every process; with more, the order of the vertices
    depends on the scheduling and the last bits of the positions on that order.

    Args:
        positions: particle positions [m], (n, 3).
        velocities: particle velocities [m/s], (n, 3).
        particle_radius: [m], half the spacing of the particles at rest.
        parameters: how the particles become a surface.
        threads: how many threads to use; fixed by the first call in a process.

    Returns:
        A closed mesh with outward unit normals and velocities; without vertices when there are no particles.

    Raises:
        ValueError: the arrays do not fit together, or the number of threads differs from the process's first call.
        SurfaceReconstructionError: positions or velocities are not finite, or splashsurf fails.
    """
    position_rows = _particle_rows("positions", positions)
    velocity_rows = _particle_rows("velocities", velocities)
    if len(position_rows) != len(velocity_rows):
        raise ValueError(f"every particle needs a velocity: {len(position_rows)} positions, {len(velocity_rows)}")
    if len(position_rows) == 0:
        nothing = np.empty((0, 3), np.float32)
        return SurfaceMesh(nothing, np.empty((0, 3), np.int32), nothing, nothing)
    splashsurf = _with_thread_pool(threads)
    try:
        reconstructed, _ = splashsurf.reconstruction_pipeline(
            position_rows,
            attributes_to_interpolate={"velocity": velocity_rows},
            particle_radius=particle_radius,
            multi_threading=threads > 1,
            **pipeline_options(parameters),
        )
    except RuntimeError as error:
        raise SurfaceReconstructionError(f"splashsurf failed on {len(position_rows)} particles: {error}") from error
    attributes = reconstructed.point_attributes
    mesh = without_collapsed_parts(
        SurfaceMesh(
            vertices=np.array(reconstructed.mesh.vertices, np.float32),
            faces=np.array(reconstructed.mesh.triangles, np.int32),
            normals=np.array(attributes["normals"], np.float32),
            velocities=np.array(attributes["velocity"], np.float32),
        )
    )
    return shrink_droplets(mesh, position_rows, particle_radius=particle_radius, size=parameters.droplet_size)


def without_collapsed_parts(mesh: SurfaceMesh) -> SurfaceMesh:
    """Drop the parts of a surface that have no volume, and make sure that every normal is a unit vector.

    Mesh cleanup now and then collapses a cavity to two triangles back to back, and splashsurf gives their vertices no
    normal (NaN). A vertex without a normal in a part that does have volume takes the mean of its triangles.

    Raises:
        SurfaceReconstructionError: a vertex of a part with volume has triangles of no area only.
    """
    assert mesh.normals is not None and mesh.velocities is not None
    undefined = ~np.isfinite(mesh.normals).all(axis=1)
    if not undefined.any():
        return mesh
    faces = mesh.faces[~undefined[mesh.faces].all(axis=1)]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    kept = used | ~undefined
    normals = mesh.normals.copy()
    for vertex in np.flatnonzero(undefined & used):
        normals[vertex] = _mean_normal(mesh.vertices, faces[(faces == vertex).any(axis=1)])
    number = np.cumsum(kept, dtype=np.int32) - 1
    return SurfaceMesh(
        vertices=mesh.vertices[kept],
        faces=number[faces].astype(np.int32),
        normals=normals[kept],
        velocities=mesh.velocities[kept],
    )


def _mean_normal(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Unit normal of the sum of some triangles' area vectors."""
    corners = vertices[faces].astype(np.float64)
    total = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    length = float(np.linalg.norm(total))
    if length == 0.0:
        raise SurfaceReconstructionError(f"the surface has no direction at {corners[0, 0].tolist()}")
    return np.asarray(total / length)


def pipeline_options(parameters: SurfaceParameters) -> dict[str, Any]:
    """The arguments of `pysplashsurf.reconstruction_pipeline` that these parameters stand for."""
    return {
        "smoothing_length": parameters.smoothing_length_in_radii,
        "cube_size": parameters.cube_size_in_radii,
        "iso_surface_threshold": parameters.threshold,
        "mesh_cleanup": True,
        "decimate_barnacles": True,
        "mesh_smoothing_weights": True,
        "mesh_smoothing_iters": parameters.mesh_smoothing_iterations,
        "compute_normals": True,
        "normals_smoothing_iters": parameters.normals_smoothing_iterations,
    }


def _particle_rows(name: str, values: ArrayLike) -> NDArray[np.float32]:
    rows = np.ascontiguousarray(values, np.float32)
    if rows.size == 0:
        return rows.reshape(0, 3)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"{name} must have the shape (n, 3), got {rows.shape}")
    if not np.isfinite(rows).all():
        particle = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise SurfaceReconstructionError(f"{name} of particle {particle} are not finite: {rows[particle].tolist()}")
    return rows


_pool_threads: int | None = None


def _with_thread_pool(threads: int) -> Any:
    """Import splashsurf with a pool of that many threads.

    The pool is the process's: it reads RAYON_NUM_THREADS when first used and keeps its size. `multi_threading=False`
    alone does not keep splashsurf from using it.
    """
    global _pool_threads  # noqa: PLW0603 - it mirrors the process-wide pool
    import pysplashsurf

    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    if _pool_threads is None:
        before = os.environ.get("RAYON_NUM_THREADS")
        os.environ["RAYON_NUM_THREADS"] = str(threads)
        try:
            particle = np.zeros((1, 3), np.float32)
            pysplashsurf.reconstruct_surface(particle, particle_radius=1.0, smoothing_length=2.0, cube_size=1.0)
        finally:
            if before is None:
                del os.environ["RAYON_NUM_THREADS"]
            else:
                os.environ["RAYON_NUM_THREADS"] = before
        _pool_threads = threads
    if threads != _pool_threads:
        raise ValueError(f"this process meshes with {_pool_threads} threads since its first surface, got {threads}")
    return pysplashsurf
