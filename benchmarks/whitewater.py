"""What a frame of whitewater costs: `python -m benchmarks.whitewater [--particles N] [--cloud N] [--repeats N]`.

A stirred pool and a cloud in and above it, advanced by one frame from memory, again and again. Prints JSON: the least
time and the median, and the peak memory of the process.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
from dataclasses import replace
from time import perf_counter

import numpy as np

from sim.domain import DomainParameters
from sim.runtime import initialize
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.motion import FluidState
from sim.whitewater.parameters import WhitewaterParameters
from sim.whitewater.solver import WhitewaterSolver

RADIUS = 0.005
FPS = 60.0
SPEED = 2.0
"""Of the stirring [m/s]: some 1.7 support radii a frame, so two substeps."""


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


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--particles", type=int, default=400_000)
    arguments.add_argument("--cloud", type=int, default=500_000)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--threads", type=int, default=2)
    options = arguments.parse_args()

    initialize("cpu", threads=options.threads)
    begin, end, domain = stirred_pool(options.particles)
    cloud = cloud_in(domain, options.cloud)
    solver = WhitewaterSolver(WhitewaterParameters(), domain=domain, gravity=(0.0, 0.0, -9.81), frames_per_second=FPS)
    seconds = []
    for _ in range(options.repeats + 1):  # the first compiles
        start = perf_counter()
        after, report = solver.advance_frame(cloud, begin, end, frame=1, particle_radius=RADIUS)
        seconds.append(perf_counter() - start)
    print(
        json.dumps(
            {
                "benchmark": "whitewater",
                "fluid_particles": len(begin.position),
                "cloud_before": len(cloud),
                "cloud_after": len(after),
                "generated": report.generated,
                "substeps": report.substeps,
                "threads": options.threads,
                "frame_s": round(min(seconds[1:]), 3),
                "frame_median_s": round(statistics.median(seconds[1:]), 3),
                "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
