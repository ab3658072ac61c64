"""What the surface stage costs beyond splashsurf itself: `python -m benchmarks.surface [--particles N] [--repeats N]`.

Both sides mesh the same arrays with the same options, one thread each, in turns, so that a busy machine slows both
alike; the ratio is the median of the pairs' ratios. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

from render.meshes import SurfaceMesh, validate_ply, write_ply
from render.parameters import SurfaceParameters
from render.surface import pipeline_options, reconstruct_surface

RADIUS = 0.005


def splash(particles: int) -> np.ndarray:
    """About that many particles: a pool at rest of three times the width as height, one in fifty of them spray."""
    count = max(2, round((particles / 9 * 0.98) ** (1 / 3)))
    axes = [np.arange(3 * count), np.arange(3 * count), np.arange(count)]
    pool = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2 * RADIUS
    random = np.random.default_rng(0)
    pool += random.normal(0, 0.1 * RADIUS, pool.shape)
    spray = random.uniform(0, 1, (len(pool) // 50, 3)) * pool.max(axis=0) * [1, 1, 2] + [0, 0, pool[:, 2].max()]
    return np.concatenate([pool, spray]).astype(np.float32)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--particles", type=int, default=100_000)
    arguments.add_argument("--repeats", type=int, default=7)
    options = arguments.parse_args()

    positions = splash(options.particles)
    velocities = positions[:, ::-1].copy()
    parameters = SurfaceParameters()
    # The first surface sizes splashsurf's thread pool, for both sides.
    mesh = reconstruct_surface(positions, velocities, particle_radius=RADIUS, parameters=parameters, threads=1)
    import pysplashsurf

    def direct() -> None:
        pysplashsurf.reconstruction_pipeline(
            positions,
            attributes_to_interpolate={"velocity": velocities},
            particle_radius=RADIUS,
            multi_threading=False,
            **pipeline_options(parameters),
        )

    def ours() -> SurfaceMesh:
        return reconstruct_surface(positions, velocities, particle_radius=RADIUS, parameters=parameters, threads=1)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface.ply"

        def ours_to_file() -> None:
            surface = ours()
            write_ply(path, surface.vertices, surface.faces, normals=surface.normals, velocities=surface.velocities)
            validate_ply(path)

        rounds = [(_seconds(direct), _seconds(ours), _seconds(ours_to_file)) for _ in range(options.repeats)]
        file_bytes = path.stat().st_size
    print(
        json.dumps(
            {
                "benchmark": "surface",
                "particles": len(positions),
                "vertices": len(mesh.vertices),
                "triangles": len(mesh.faces),
                "file_bytes": file_bytes,
                "threads": 1,
                "direct_s": round(min(times[0] for times in rounds), 4),
                "reconstruct_s": round(min(times[1] for times in rounds), 4),
                "reconstruct_write_validate_s": round(min(times[2] for times in rounds), 4),
                "reconstruct_ratio": round(statistics.median(times[1] / times[0] for times in rounds), 3),
                "reconstruct_write_validate_ratio": round(
                    statistics.median(times[2] / times[0] for times in rounds), 3
                ),
            },
            indent=1,
        )
    )


def _seconds(call: Callable[[], object]) -> float:
    start = perf_counter()
    call()
    return perf_counter() - start


if __name__ == "__main__":
    main()
