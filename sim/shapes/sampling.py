"""Points in and on solids: particles that fill a volume, samples that cover a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sim.shapes.solid import ShapeError, Solid, TriangleMesh

_ROUND_OFF = 1.0e-6  # slack, in lattice spacings, that forgives decimal sizes such as 0.3 / 0.02 their binary round-off
_MIN_DISTANCE = 0.8  # of two samples, in spacings: a maximal random set then holds one per spacing squared
_CANDIDATES_PER_SAMPLE = 16  # their own gaps, a quarter of a spacing, add to those between samples
_LARGEST_LATTICE = 2**31
_LAYER_POINTS = 2**20
_MOST_SAMPLES = 1.0e7


def fill_with_particles(
    solid: Solid, spacing: float, *, lower: ArrayLike | None = None, upper: ArrayLike | None = None
) -> NDArray[np.float32]:
    """Positions [m], (n, 3), of particles on a cubic lattice, at least half a spacing [m] inside the surface.

    The lattice is centred in the solid's bounds, cut by the corners `lower` and `upper` [m], from which particles stay
    half a spacing, too; a box of k spacings gets exactly k³ particles. In the order of the lattice, z fastest.

    Raises:
        ShapeError: the lattice would have more than 2³¹ points.
    """
    low, high = solid.bounds
    if lower is not None:
        low = np.maximum(low, np.asarray(lower, dtype=np.float64))
    if upper is not None:
        high = np.minimum(high, np.asarray(upper, dtype=np.float64))
    counts = np.floor((high - low) / spacing + _ROUND_OFF)
    if np.any(counts < 1.0):
        return np.empty((0, 3), dtype=np.float32)
    if np.prod(counts) > _LARGEST_LATTICE:
        raise ShapeError(
            f"filling {' x '.join(f'{edge:g}' for edge in high - low)} m at a spacing of {spacing:g} m takes "
            f"{np.prod(counts):.2g} lattice points; use a larger spacing or a smaller volume"
        )
    first = 0.5 * (low + high) - 0.5 * (counts - 1.0) * spacing
    x, y, z = (start + spacing * np.arange(int(count)) for start, count in zip(first, counts, strict=True))

    kept = []
    layers = max(1, _LAYER_POINTS // (len(y) * len(z)))  # bounds the memory of the distance queries
    for start in range(0, len(x), layers):
        points = np.stack(np.meshgrid(x[start : start + layers], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
        depth = -solid.signed_distance(points)
        kept.append(points[depth >= (0.5 - _ROUND_OFF) * spacing].astype(np.float32))
    return np.concatenate(kept)


def sample_surface(mesh: TriangleMesh, spacing: float) -> NDArray[np.float32]:
    """Positions [m], (m, 3), evenly spread on a surface, about one per spacing [m] squared (Akinci et al. 2012).

    A maximal Poisson-disk set: no two samples are closer than 0.8 spacings, no point of the surface is farther than
    1.05 spacings from a sample. Candidates are stratified by area; rounds accept, of the first remaining candidate of
    every grid cell, those that come first among their neighbours, and drop what is then too close (after Wei 2008,
    "Parallel Poisson disk sampling"). The same mesh and spacing give the same samples.

    Raises:
        ShapeError: the surface has no area, or would take more than ten million samples.
    """
    candidates = _candidates(mesh, spacing)
    radius = _MIN_DISTANCE * spacing
    cell = np.floor((candidates - candidates.min(axis=0)) / (radius / np.sqrt(3.0))).astype(np.int64)
    cell_count = cell.max(axis=0) + 1
    cell_key = (cell[:, 0] * cell_count[1] + cell[:, 1]) * cell_count[2] + cell[:, 2]

    accepted = []
    while len(candidates):
        _, first = np.unique(cell_key, return_index=True)
        representatives = candidates[first]
        pairs = cKDTree(representatives).query_pairs(radius, output_type="ndarray")
        # Candidates stand in random order, so that their index is their priority.
        later = np.where(first[pairs[:, 0]] > first[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
        chosen = np.ones(len(first), dtype=bool)
        chosen[later] = False
        accepted.append(representatives[chosen])
        distance, _ = cKDTree(accepted[-1]).query(candidates, distance_upper_bound=radius, workers=-1)
        remaining = ~np.isfinite(distance)
        candidates, cell_key = candidates[remaining], cell_key[remaining]
    return np.concatenate(accepted).astype(np.float32)


def stratified_points(mesh: TriangleMesh, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Deterministic points [m], (count, 3), on a surface, evenly by area, and the face of each, (count,).

    Equal steps along the cumulated area give every face its share; the plastic-number sequence (Roberts 2018, "The
    unreasonable effectiveness of quasirandom sequences") places the points within the faces.
    """
    cumulated_area = np.cumsum(np.linalg.norm(mesh.area_vectors, axis=1))
    face = np.searchsorted(cumulated_area, (np.arange(count) + 0.5) * (cumulated_area[-1] / count), side="right")
    plastic = 1.324717957244746
    u, v = (np.outer([1.0 / plastic, 1.0 / plastic**2], np.arange(1, count + 1))) % 1.0
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    return np.einsum("ij,ijk->ik", weights, mesh.corners[face]), face


def _candidates(mesh: TriangleMesh, spacing: float) -> NDArray[np.float64]:
    """Dense points on the surface in random order."""
    area = float(np.linalg.norm(mesh.area_vectors, axis=1).sum())
    if not area > 0.0:
        raise ShapeError("the surface to be sampled has no area; check the mesh for collapsed faces")
    samples = area / spacing**2
    if samples > _MOST_SAMPLES:
        raise ShapeError(
            f"sampling {area:g} m² at a spacing of {spacing:g} m takes {samples:.2g} samples; "
            "use a larger spacing or a smaller body"
        )
    points, _ = stratified_points(mesh, int(np.ceil(_CANDIDATES_PER_SAMPLE * samples)))
    return points[np.random.default_rng(0).permutation(len(points))]
