"""What a frame of a fluid's surface costs, and one of its whitewater; JSON on the standard output.

    python -m benchmarks.surface [--particles 100000] [--repeats 7]
    python -m benchmarks.surface --whitewater [--particles 400000] [--cloud 500000] [--repeats 5] [--threads 2]

The surface stage against splashsurf itself: both sides mesh the same arrays with the same options, one thread each, in
turns, so that a busy machine slows both alike; the ratio is the median of the pairs' ratios.

Whitewater: a stirred pool and a cloud in and above it, advanced by one frame from memory, again and again: least and
median time, and the peak memory of the process.
"""

import argparse
import resource
import statistics
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.compare import arguments_of, run, timed
from render.meshes import SurfaceMesh, validate_ply, write_ply
from render.parameters import SurfaceParameters
from render.surface import pipeline_options, reconstruct_surface
from sim.core.domain import DomainParameters
from sim.core.runtime import initialize
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.motion import FluidState
from sim.whitewater.parameters import WhitewaterParameters

RADIUS = 0.005
FPS = 60.0
SPEED = 2.0
"""Of the stirring [m/s]: some 1.7 support radii a frame, so two substeps."""


def splash(particles: int) -> np.ndarray:
    """About that many particles: a pool at rest of three times the width as height, one in fifty of them spray."""
    count = max(2, round((particles / 9 * 0.98) ** (1 / 3)))
    axes = [np.arange(3 * count), np.arange(3 * count), np.arange(count)]
    pool = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2 * RADIUS
    random = np.random.default_rng(0)
    pool += random.normal(0, 0.1 * RADIUS, pool.shape)
    spray = random.uniform(0, 1, (len(pool) // 50, 3)) * pool.max(axis=0) * [1, 1, 2] + [0, 0, pool[:, 2].max()]
    return np.concatenate([pool, spray]).astype(np.float32)


def measure_surface(particles: int, repeats: int) -> dict[str, Any]:
    """Seconds of splashsurf alone, of the meshing around it, and of that with writing and checking the file."""
    positions = splash(particles)
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

        rounds = [tuple(timed(side)[0] for side in (direct, ours, ours_to_file)) for _ in range(repeats)]
        file_bytes = path.stat().st_size
    return {
        "particles": len(positions),
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "file_bytes": file_bytes,
        "direct_s": round(min(times[0] for times in rounds), 4),
        "reconstruct_s": round(min(times[1] for times in rounds), 4),
        "reconstruct_write_validate_s": round(min(times[2] for times in rounds), 4),
        "reconstruct_ratio": round(statistics.median(times[1] / times[0] for times in rounds), 3),
        "reconstruct_write_validate_ratio": round(statistics.median(times[2] / times[0] for times in rounds), 3),
    }


def stirred_pool(particles: int) -> tuple[FluidState, FluidState, DomainParameters]:
    """About that many particles, twice as wide as deep, in rolls and with rough speeds; this frame and the next."""
    count = max(4, round((particles / 4) ** (1 / 3)))
    axes = [np.arange(2 * count), np.arange(2 * count), np.arange(count)]
    start = (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * 2 * RADIUS
    random = np.random.default_rng(0)
    start += random.uniform(-0.3, 0.3, start.shape) * RADIUS
    phase = np.pi * start / start.max(axis=0)
    rolls = np.stack([np.sin(phase[:, 0]) * np.cos(phase[:, 2]), 0 * phase[:, 1], -np.cos(phase[:, 0])], axis=1)
    velocity = SPEED * (rolls + random.normal(0, 0.1, start.shape))
    ids = np.arange(len(start), dtype=np.int32)
    begin = FluidState(ids, start.astype(np.float32), velocity.astype(np.float32))
    end = replace(begin, position=(start + velocity / FPS).astype(np.float32))
    high = start.max(axis=0) * [1, 1, 2]
    return begin, end, DomainParameters(min=(0.0, 0.0, 0.0), max=tuple(high.tolist()))


def cloud_in(domain: DomainParameters, particles: int) -> WhitewaterCloud:
    """Particles all over the domain."""
    random = np.random.default_rng(1)
    return WhitewaterCloud(
        position=random.uniform(domain.min, domain.max, (particles, 3)).astype(np.float32),
        velocity=random.normal(0, SPEED, (particles, 3)).astype(np.float32),
        radius=np.full(particles, 0.2 * RADIUS, np.float32),
        lifetime=np.full(particles, 1.0, np.float32),
        kind=np.full(particles, WhitewaterKind.FOAM, np.uint8),
    )


def measure_whitewater(options: argparse.Namespace) -> dict[str, Any]:
    """Seconds of a frame."""
    initialize("cpu", threads=options.threads)
    from sim.whitewater.solver import WhitewaterSolver

    begin, end, domain = stirred_pool(options.particles or 400_000)
    cloud = cloud_in(domain, options.cloud)
    solver = WhitewaterSolver(WhitewaterParameters(), domain=domain, gravity=(0.0, 0.0, -9.81), frames_per_second=FPS)
    answers = []

    def frame() -> None:
        answers.append(solver.advance_frame(cloud, begin, end, frame=1, particle_radius=RADIUS))

    frame()  # compiles
    seconds = [timed(frame)[0] for _ in range(options.repeats)]
    after, report = answers[-1]
    return {
        "fluid_particles": len(begin.position),
        "cloud_before": len(cloud),
        "cloud_after": len(after),
        "generated": report.generated,
        "substeps": report.substeps,
        "threads": options.threads,
        "frame_s": round(min(seconds), 3),
        "frame_median_s": round(statistics.median(seconds), 3),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--whitewater", action="store_true")
    parser.add_argument("--particles", type=int)
    parser.add_argument("--cloud", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    if options.whitewater:
        return measure_whitewater(options)
    return measure_surface(options.particles or 100_000, options.repeats)


if __name__ == "__main__":
    run(main)
