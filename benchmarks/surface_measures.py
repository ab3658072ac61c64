"""Meshes one frame's particles with one set of options, in a process of its own, and tells what that took and gave.

    python -m benchmarks.surface_measures particles.npz surface.ply '{"cube_size": 0.5, "droplet_size": 1}'

What `benchmarks.surface_looks` runs for each of its settings: only the peak of a process that does nothing else is the
memory of one meshing. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.executors.memory import peak_memory_bytes
from render.droplets import connected_parts
from render.meshes import SurfaceMesh, write_ply
from render.parameters import SurfaceParameters
from render.surface import pipeline_options, reconstruct_surface, reconstruct_with_options

DROPLET_IN_PARTICLES = 8.0
"""Parts of a surface with less volume than that of so many particles count as droplets."""

BODY_NEIGHBOURS = 15
"""Particles with so many others within four radii lie in or on the body of the water: a flat surface of a lattice at
rest leaves 20 of 32, an edge 13, a sheet one particle thick 12."""

PLACES = 4000
"""Enough to tell the median of the bumps to a few percent; each has hundreds of vertices around it."""


def bumps_deg(mesh: SurfaceMesh, positions: NDArray[np.float32], radius: float) -> float | None:
    """Median angle between a normal and the mean of those within two spacings of particles [degrees].

    Only of the surface of the body of water, where a bump as wide as a particle is none of the water's: sheets and
    drops are curved by nature. None where there is no such surface.
    """
    particles = cKDTree(positions)
    _, nearest = particles.query(mesh.vertices)
    neighbours = particles.query_ball_point(positions, 4 * radius, return_length=True) - 1
    on_body = np.flatnonzero(neighbours[nearest] >= BODY_NEIGHBOURS)
    chosen = np.random.default_rng(0).permutation(on_body)[:PLACES]
    if len(chosen) == 0:
        return None
    angles = []
    around = cKDTree(mesh.vertices).query_ball_point(mesh.vertices[chosen], 4 * radius)
    for vertex, others in zip(chosen, around, strict=True):
        mean = mesh.normals[others].sum(axis=0, dtype=np.float64)
        cosine = mesh.normals[vertex] @ mean / np.linalg.norm(mean)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return float(np.median(angles))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("particles", type=Path, help="positions, velocities and radius, as .npz")
    parser.add_argument("output", type=Path, help="the PLY to write")
    parser.add_argument("options", type=json.loads, help="droplet_size, and arguments of splashsurf unlike a job's")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    with np.load(arguments.particles) as file:
        positions, velocities, radius = file["positions"], file["velocities"], float(file["radius"])
    usual = SurfaceParameters()
    options = {**pipeline_options(usual), **arguments.options}
    size = options.pop("droplet_size", usual.droplet_size)
    # The first surface sizes splashsurf's thread pool and loads what is used; one particle counts little.
    reconstruct_surface(positions[:1], velocities[:1], particle_radius=radius, parameters=usual)

    before = peak_memory_bytes()
    walls, processors = [], []
    for _ in range(arguments.repeats):
        wall, processor = time.perf_counter(), time.process_time()
        mesh = reconstruct_with_options(
            positions, velocities, particle_radius=radius, options=options, droplet_size=size
        )
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    peak = peak_memory_bytes()

    write_ply(arguments.output, mesh.vertices, mesh.faces, normals=mesh.normals, velocities=mesh.velocities)
    parts = connected_parts(mesh)[1] / (2 * radius) ** 3
    droplets = parts[(parts > 0) & (parts < DROPLET_IN_PARTICLES)]
    bumps = bumps_deg(mesh, positions, radius)
    print(
        json.dumps(
            {
                "wall_s": round(statistics.median(walls), 3),
                "cpu_s": round(statistics.median(processors), 3),
                "memory_mb": round((peak - before) / 2**20, 1),
                "triangles": len(mesh.faces),
                "volume_error": round(float(parts.sum()) / len(positions) - 1, 4),
                "bumps_deg": None if bumps is None else round(bumps, 2),
                "parts": int((parts > 0).sum()),
                "droplets": len(droplets),
                "droplet_width_in_radii": round(float(np.median(np.cbrt(6 / np.pi * 8 * droplets))), 2)
                if len(droplets)
                else None,
            }
        )
    )


if __name__ == "__main__":
    main()
