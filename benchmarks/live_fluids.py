"""What fluids take to step live, and what `pipeline live` says beforehand that they will; JSON on the standard output.

    python -m benchmarks.live_fluids jobs/honey.toml --seconds 0.5 --cores 2 [--preview] [--set KEY=VALUE ...]

The scene runs as in the command, without its page, until so many seconds of it, or --wall of the wall, have passed. Of
each tenth of its frames: when it ends, particles then, steps a frame, largest speed [m/s], the median of the wall time
and the mean of the processor time of a frame [ms], and the processor time of a particle in a step [us]. `expected` is
what `pipeline.live.fluid_pace` says of all of the job. The load of the machine stands beside them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from pipeline.job.checks import load_checked_job
from pipeline.live.fluid_pace import fluid_frame_s, steps_a_frame
from pipeline.live.scene import live_job
from pipeline.live.session import Session
from sim.runtime import initialize

PARTS = 10


def part(session: Session, frames: int) -> dict[str, Any]:
    """Compute so many frames, and measure."""
    times, steps, particle_steps, numbers = [], 0, 0.0, {}
    processor = time.process_time()
    for _ in range(frames):
        session.advance()
        assert session.report is not None, session.message
        ((solver, numbers),) = ((name, of) for name, of in session.report.diagnostics.items() if "particle_count" in of)
        times.append(session.status().frame_ms)
        steps += session.report.substeps[solver]
        particle_steps += session.report.substeps[solver] * numbers["particle_count"]
    processor = time.process_time() - processor
    return {
        "time_s": session.world.time_s,
        "particles": int(numbers["particle_count"]),
        "steps_a_frame": steps / frames,
        "max_speed": numbers["max_speed"],
        "frame_ms": statistics.median(times),
        "processor_ms": 1e3 * processor / frames,
        "particle_step_us": 1e6 * processor / max(particle_steps, 1.0),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", type=Path)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--wall", type=float, default=60.0)
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--preview", action="store_true")
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    device = initialize("cpu", threads=arguments.cores)
    loaded, findings = load_checked_job(arguments.job, arguments.set, preview=arguments.preview)
    job = live_job(loaded.job)
    session = Session(job, patience_s=math.inf)
    for _ in range(3):
        session.advance()  # kernels
    parts = []
    frames = max(1, round(arguments.seconds * job.fps / PARTS))
    end = time.perf_counter() + arguments.wall
    while len(parts) < PARTS and time.perf_counter() < end:
        parts.append(part(session, frames))
    told = {
        "job": job.name,
        "device": device,
        "cores": arguments.cores,
        "load": os.getloadavg(),
        "expected": {
            "particles": findings.particles,
            "steps_a_frame": steps_a_frame(job),
            "frame_ms": 1e3 * fluid_frame_s(job, findings.particles, power=arguments.cores),
            "processor_ms": 1e3 * fluid_frame_s(job, findings.particles, power=1),
        },
        "parts": parts,
    }
    json.dump(told, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
