"""How many particle-steps per second the WCSPH solver makes in a dam break; JSON on the standard output.

python benchmarks/wcsph.py --particles 100000 --steps 20 --device cpu
"""

import argparse
import json
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from sim.runtime import initialize

SPACING = 0.02


def lattice(shape: tuple[int, int, int]) -> np.ndarray:
    axes = [(np.arange(count) + 0.5) * SPACING for count in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=100_000, help="about how many particles")
    parser.add_argument("--steps", type=int, default=20, help="steps per block")
    parser.add_argument("--blocks", type=int, default=7, help="blocks; their median counts")
    parser.add_argument("--warm-up", type=float, default=0.1, help="simulated seconds before the first block")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    device = initialize(arguments.device, threads=arguments.threads)

    from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
    from sim.fluid.parameters import FluidParameters
    from sim.fluid.memory import estimate_bytes
    from sim.fluid.wcsph import WCSPHSolver
    from sim.scene import DomainParameters

    # A dam as high as wide and deep, in a channel twice as long.
    side = max(round(arguments.particles ** (1 / 3)), 2)
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(2 * side * SPACING, side * SPACING, 1.5 * side * SPACING))
    positions = lattice((side, side, side))
    material = FluidParameters.model_validate(
        {"name": "water", "block": [{"shape": {"type": "box", "size": (1, 1, 1)}}]}
    )
    fluid = WCSPHSolver(
        material,
        domain=domain,
        gravity=(0.0, 0.0, -9.81),
        positions=positions,
        velocities=np.zeros_like(positions),
        boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, SPACING)),
    )
    simulated = 0.0
    while simulated < arguments.warm_up:
        dt = fluid.stable_dt()
        fluid.substep(dt)
        simulated += dt
    fluid.begin_frame(simulated)
    rates, core_rates = [], []
    for _ in range(arguments.blocks):
        start, start_cpu = time.perf_counter(), time.process_time()
        for _ in range(arguments.steps):
            fluid.substep(fluid.stable_dt())
        fluid.synchronize()
        work = fluid.particle_count * arguments.steps
        rates.append(work / (time.perf_counter() - start))
        core_rates.append(work / (time.process_time() - start_cpu))
    state = fluid.diagnostics()
    result = {
        "particles": fluid.particle_count,
        "boundary_samples": fluid.boundary.count,
        "device": device,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "particle_steps_per_s": {
            "median": float(np.median(rates)),
            "best": max(rates),
            "worst": min(rates),
            "blocks": len(rates),
        },
        # By processor time, so that other programs on the same cores do not count; means little on a GPU.
        "particle_steps_per_core_s": {"median": float(np.median(core_rates)), "best": max(core_rates)},
        "steps_per_neighbor_search": state["substeps"] / max(state["neighbor_searches"], 1.0),
        "list_entries_per_particle": fluid.mean_neighbors,
        "bytes_per_particle": estimate_bytes(fluid.particle_count, fluid.boundary.count, fluid.cell_count)
        / fluid.particle_count,
        "peak_resident_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
