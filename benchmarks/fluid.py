"""Speed and memory of the SPH solvers in a dam break; JSON on the standard output.

    python -m benchmarks.fluid --solver wcsph --particles 100000 1000000 --device cuda [--support 4] [--plot cost.svg]

A cube of fluid falls apart in a channel twice as long, with gravity, viscosity and walls, neighbour searches included.
Times are of blocks of steps after a while of simulated time; of the blocks the median counts. The processor time of
all threads stands beside them, as other programs on the same cores do not enter it (on a GPU it says nothing).
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.compare import arguments_of, array_bytes, machine, run, spread, start_taichi, timed
from sim.core.domain import DomainParameters
from sim.fluid.parameters import FluidParameters
from sim.fluid.traits import TRAITS

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid

SPACING = 0.02
EARTH = (0.0, 0.0, -9.81)


def make_dam(solver: str, particles: int, support_in_spacings: float, **parameters: float) -> SPHFluid:
    """A dam of about so many particles, as high as wide and deep."""
    from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
    from sim.fluid.solvers import SOLVERS
    from sim.fluid.tank import FluidStart

    side = max(round(particles ** (1 / 3)), 2)
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(2 * side * SPACING, side * SPACING, 1.5 * side * SPACING))
    axis = (np.arange(side) + 0.5) * SPACING
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    material = FluidParameters.model_validate(
        {
            "name": "water",
            "solver": solver,
            "block": [{"shape": {"type": "box", "size": (1, 1, 1)}}],
            "particle_radius": SPACING / 2.0,
            "support_in_spacings": support_in_spacings,
            **parameters,
        }
    )
    start = FluidStart(
        (material,),
        domain=domain,
        gravity=EARTH,
        positions=positions,
        velocities=np.zeros_like(positions),
        boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, SPACING, support_in_spacings)),
    )
    return SOLVERS[solver](start)


def measure(solver: str, particles: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """One dam: steps per second, and what a step consists of."""
    import taichi as ti

    tolerances = dict.fromkeys(("density_tolerance", "divergence_tolerance"), arguments.tolerance)
    fluid = make_dam(
        solver, particles, arguments.support, **{name: value for name, value in tolerances.items() if value is not None}
    )
    simulated = 0.0
    while simulated < arguments.warm_up:
        dt = fluid.stable_dt()
        fluid.substep(dt)
        simulated += dt
    fluid.begin_frame(simulated)
    seconds, processor_seconds = [], []
    for _ in range(arguments.blocks):
        ti.sync()
        wall, processor = timed(lambda: take_steps(fluid, arguments.steps))
        seconds.append(wall / arguments.steps)
        processor_seconds.append(processor / arguments.steps)
    if bad := fluid.first_bad_quantity():
        raise RuntimeError(f"{solver} with {particles} particles diverged: {bad}")
    state, count = fluid.diagnostics(), fluid.particle_count
    return {
        "solver": solver,
        "particles": count,
        "boundary_samples": fluid.boundary.count,
        "support_in_spacings": arguments.support,
        "neighbors_per_particle": mean_neighbors(fluid),
        "list_entries_per_particle": fluid.particles.neighbors.length / max(count, 1),
        "steps_per_neighbor_search": state["substeps"] / max(state["neighbor_searches"], 1.0),
        **{name: value for name, value in state.items() if "iterations" in name or name == "not_converged"},
        "dt_s": fluid.stable_dt(),
        "simulated_s": simulated,
        "step_ms": spread(seconds, scale=1e3),
        "step_processor_ms": spread(processor_seconds, scale=1e3),
        "million_particle_steps_per_s": count / statistics.median(seconds) / 1e6,
        "million_particle_steps_per_core_s": count / statistics.median(processor_seconds) / 1e6,
        "bytes_per_particle": {"arrays": array_bytes() / count},
        "max_compression": state["max_compression"],
    }


def take_steps(fluid: SPHFluid, count: int) -> None:
    import taichi as ti

    for _ in range(count):
        fluid.substep(fluid.stable_dt())
    ti.sync()


def mean_neighbors(fluid: SPHFluid) -> float:
    """Fluid particles within the support radius of a particle, without itself, on average."""
    from scipy.spatial import cKDTree

    tree = cKDTree(fluid.particles.host(fluid.particles.position))
    return tree.count_neighbors(tree, fluid.discretization.support_radius) / fluid.particle_count - 1.0


def draw_cost(runs: list[dict[str, Any]], path: Path) -> None:
    """Time per step over the number of particles, both logarithmic, with a line of cost linear in particles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.add_subplot(
        xscale="log", yscale="log", xlabel="particles", ylabel="time per step [ms]", title="Dam break, median of blocks"
    )
    for solver in dict.fromkeys(each["solver"] for each in runs):
        own = [each for each in runs if each["solver"] == solver]
        counts, times = [each["particles"] for each in own], [each["step_ms"]["median"] for each in own]
        axes.plot(counts, times, "o-", label=solver)
        axes.plot(counts, [times[-1] * count / counts[-1] for count in counts], "--", color="0.6", linewidth=1.0)
    axes.plot([], [], "--", color="0.6", linewidth=1.0, label="linear")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path)


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--solver", nargs="+", choices=sorted(TRAITS), default=["wcsph"])
    parser.add_argument("--particles", type=int, nargs="+", default=[100_000], help="about how many, one run each")
    parser.add_argument("--support", type=float, default=2.0, help="support radius in particle spacings")
    parser.add_argument("--tolerance", type=float, help="of implicit pressure; at 0.1 all solves make the fewest steps")
    parser.add_argument("--steps", type=int, default=20, help="steps per block")
    parser.add_argument("--blocks", type=int, default=7, help="blocks; their median counts")
    parser.add_argument("--warm-up", type=float, default=0.1, help="simulated seconds before the first block")
    parser.add_argument("--plot", type=Path, help="picture to draw of the time per step over the particles")
    parser.add_argument("--from", dest="results", type=Path, help="measure nothing: take the runs of such a JSON file")
    arguments = start_taichi(parser)
    result: dict[str, Any]
    if arguments.results is not None:
        result = json.loads(arguments.results.read_text())
    else:
        runs = [measure(solver, count, arguments) for solver in arguments.solver for count in arguments.particles]
        result = {**machine(arguments.device), "runs": runs}
    if arguments.plot is not None:
        draw_cost(result["runs"], arguments.plot)
    return result


if __name__ == "__main__":
    run(main)
