"""Fluid surfaces: particles become a closed triangle mesh that carries their velocity.

The density of the particles is sampled on a grid and contoured by marching cubes, the contour's slivers are collapsed
(Moore & Warren 1992), and a Laplacian smoothing that spares isolated droplets removes the particles' bumps (Löschner,
Böttcher, Jeske & Bender 2023, "Weighted Laplacian Smoothing for Surface Reconstruction of Particle-based Fluids").
splashsurf does the work. Before it, thin sheets and threads get further samples (`render.sheets`), and films on walls
(`render.walls`); after it, the surface is moved along its normals until it encloses as much as the particles stand for.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.meshes import SurfaceMesh
from render.parameters import SurfaceParameters
from render.sheets import samples_between
from render.walls import MIRRORED_IN_SPACINGS, Walls, films, folded_onto, mirrored, planes_of_surface

LARGEST_SHIFT_IN_RADII = 0.6
"""How far a surface is moved at most, so that no thin part is turned inside out."""
_ROUNDS = 8
_FITTED = 1e-4
"""Share of the volume that may be lacking in the end [-]."""
_WORTH_A_ROUND = 0.1 * _FITTED
"""What moving by the largest shift has to give, as a share of the volume [-]."""


class SurfaceReconstructionError(Exception):
    """Particles could not be meshed; says why."""


def reconstruct_surface(
    positions: ArrayLike,
    velocities: ArrayLike,
    *,
    particle_radius: float,
    parameters: SurfaceParameters,
    is_thin: NDArray[np.bool_] | None = None,
    volume: float | None = None,
    walls: Walls | None = None,
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
        is_thin: which particles lie in sheets and threads, (n,); none if omitted.
        volume: that the surface is to enclose [m³]; as it comes if omitted. See `with_volume`.
        walls: that the fluid wets; none if omitted.
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
    thin = np.zeros(len(position_rows), bool) if is_thin is None else is_thin
    walls, spacing = walls or Walls.nowhere(), 2.0 * particle_radius
    film = films(position_rows, velocity_rows, walls, spacing=spacing)
    own, thin = ~film.replaces, thin & ~film.replaces
    between = np.flatnonzero(thin)[samples_between(position_rows[thin], spacing)]
    samples, sample_velocities, thinness = (
        np.concatenate([rows[own], rows[between].mean(axis=1, dtype=np.float32), of_film])
        for rows, of_film in (
            (position_rows, film.position),
            (velocity_rows, film.velocity),
            (thin.astype(np.float32), np.ones(len(film.position), np.float32)),
        )
    )
    samples, sample_velocities, source = mirrored(
        samples, sample_velocities, walls, reach=MIRRORED_IN_SPACINGS * spacing
    )
    splashsurf = _with_thread_pool(threads)
    try:
        reconstructed, _ = splashsurf.reconstruction_pipeline(
            samples,
            attributes_to_interpolate={"velocity": sample_velocities, "thinness": thinness[source]},
            particle_radius=particle_radius,
            multi_threading=threads > 1,
            **pipeline_options(parameters),
        )
    except RuntimeError as error:
        raise SurfaceReconstructionError(f"splashsurf failed on {len(position_rows)} particles: {error}") from error
    attributes = reconstructed.point_attributes
    mesh = SurfaceMesh(
        vertices=np.array(reconstructed.mesh.vertices, np.float32),
        faces=np.array(reconstructed.mesh.triangles, np.int32),
        normals=np.array(attributes["normals"], np.float32),
        velocities=np.array(attributes["velocity"], np.float32),
    )
    planes = planes_of_surface(walls, particle_radius=particle_radius)
    mesh, kept = folded_onto(mesh, planes)
    if volume is not None:
        mesh = with_volume(mesh, volume, attributes["thinness"][kept], planes=planes, particle_radius=particle_radius)
    return without_collapsed_parts(mesh)


def with_volume(
    mesh: SurfaceMesh, volume: float, thinness: NDArray[Any], *, planes: Walls, particle_radius: float
) -> SurfaceMesh:
    """Move a closed surface along its normals until it encloses a volume [m³], as far as that goes.

    Contour and smoothing take most from what is thin or curved: sheets and threads, (n,) between 0 and 1 at the
    vertices, are moved first, and the rest only by what is lacking then. No vertex moves farther than
    `LARGEST_SHIFT_IN_RADII`, and none without a normal; those on planes stay on them, and none passes one.
    """
    if not len(mesh.faces):
        return mesh
    assert mesh.normals is not None
    corners, directions = mesh.vertices.astype(np.float64), np.nan_to_num(mesh.normals.astype(np.float64))
    directions[(corners <= planes.low) | (corners >= planes.high)] = 0.0
    largest = LARGEST_SHIFT_IN_RADII * particle_radius
    shift = np.zeros(len(corners))
    for weights in (np.clip(np.nan_to_num(thinness), 0.0, 1.0).astype(np.float64), np.ones(len(corners))):
        for _ in range(_ROUNDS):
            moved = np.clip(corners + shift[:, None] * directions, planes.low, planes.high)
            areas = _area_vectors(moved, mesh.faces)
            lacking = volume - np.einsum("ij,ij->", moved[mesh.faces[:, 0]], areas) / 3.0
            if abs(lacking) <= _FITTED * volume:
                break
            # d(volume) = sum over vertices of a third of the areas around it . its direction
            along = np.stack([np.einsum("ij,ij->i", areas, directions[ends]) for ends in mesh.faces.T], axis=1)
            gain = np.bincount(mesh.faces.reshape(-1), along.reshape(-1), minlength=len(corners)) / 3.0
            movable = weights * ((shift < largest) if lacking > 0.0 else (shift > -largest))
            total = float(movable @ gain)
            if total * largest <= _WORTH_A_ROUND * volume:
                break
            shift = np.clip(shift + lacking / total * movable, -largest, largest)
    moved = np.clip(corners + shift[:, None] * directions, planes.low, planes.high)
    return replace(mesh, vertices=moved.astype(np.float32))


def _area_vectors(corners: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area of each triangle times its normal [m²], (m, 3)."""
    a, b, c = (corners[ends] for ends in faces.T)
    (x, y, z), (u, v, w) = np.ascontiguousarray((b - a).T), np.ascontiguousarray((c - a).T)
    return np.asarray(0.5 * np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1))


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
