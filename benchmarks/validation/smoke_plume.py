"""Smoke that rises: how a warm ball starts, a thermal at each resolution, and whether a plume's mass is kept."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.smoke_boxes import Advection, advance, build_box, set_flow
from sim.shapes import build_solid
from sim.shapes.parameters import Placement, SphereShape

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

SOLVERS = ("maccormack",)

GRAVITY = 9.81
EXCESS, AMBIENT = 60.0, 293.0
"""Temperature of the source and of the ball above the air's, and the air's [K]."""

BALL_CELLS, RADIUS = 48, 0.1
"""Across the closed box of 1 m, and radius of the ball in its middle [m]."""

THERMAL_CELLS, THERMAL_RADIUS, THERMAL_HEIGHT = (16, 32, 64, 128), 0.15, 0.4
"""Across the closed box of 1 m with a thermal, where its heat has fallen to 1/e, and how high it begins [m]."""

THERMAL_DURATION, THERMAL_SAMPLES, THERMAL_STEPS_PER_CELL = 0.5, 5, 4
"""How long it rises [s], how often it is looked at, and steps in which air at 1 m/s crosses a cell."""

CLOSED_CELLS, AROUND_CELLS, HEIGHT = 32, 24, 1.5
"""Cells a metre of the plumes in a closed box and past a ball, and height of their boxes [m]."""

DURATION, SAMPLES = 1.4, 14
"""How long a plume rises [s], and how often its smoke is summed up."""

OBSTACLE = Placement(shape=SphereShape(type="sphere", radius=0.15), position=(0.5, 0.5, 0.7))


def run(solver: Advection, *, quick: bool = False) -> CaseResult:
    """Warm ball, a thermal at several resolutions, mass in a closed box and past an obstacle in an open one."""
    counts = THERMAL_CELLS[:3] if quick else THERMAL_CELLS
    boxes = {n: _box_of_air(n, solver) for n in counts}
    thermals = {n: _thermal(box) for n, box in boxes.items()}
    # Each box costs the compilation of its kernels: the quick ball is in the finest one of the thermal.
    ball_box = boxes[counts[-1]] if quick else _box_of_air(BALL_CELLS, solver)
    closed = _plume(CLOSED_CELLS // 2 if quick else CLOSED_CELLS, solver)
    around = _plume(AROUND_CELLS, solver, solids=[build_solid(OBSTACLE)], open_faces=("x-", "x+", "y-", "y+"))
    checks = [
        Check("acceleration in the middle of a warm ball over 2/3 of its buoyancy", _warm_ball(ball_box), 1.0, 0.02,
              "it drives half its volume of air around it; cubes for a ball, and walls five radii away"),
        Check("order of the way of a thermal", _order(thermals, "rises"), 1.5, 0.5,
              "steps are refined with cells: first order in time and second in space, of which neither prevails"),
        Check("order of its largest speed", _order(thermals, "speeds"), 1.75, 0.45,
              "likewise"),
        Check("way of the thermal at half the resolution, over that at the finest", _halved(thermals), 1.0, 0.04,
              "converged: at first order the finest is as far from the limit"),
    ]  # fmt: skip
    checks += [
        Check(f"smoke {name} over what was emitted", plume["kept"][-1], 1.0, 0.01, "required: corrections are balanced")
        for name, plume in (("in a closed box", closed), ("past a ball in an open box", around))
    ]
    checks.append(
        Check("projections that did not converge", sum(plume["failed"] for plume in (closed, around)), 0.0, 0.0,
              "a count")
    )  # fmt: skip
    series: dict[str, Any] = {"cells": list(counts), "times": closed["times"], "kept_closed": closed["kept"],
                              "kept_around": around["kept"],
                              "thermal_times": thermals[counts[0]]["times"]}  # fmt: skip
    series |= {f"rises_{n}": thermal["rises"] for n, thermal in thermals.items()}
    settings = {"excess_k": EXCESS, "radius_m": RADIUS, "height_m": HEIGHT, "duration_s": DURATION,
                "thermal_radius_m": THERMAL_RADIUS}  # fmt: skip
    return CaseResult("smoke-plume", solver, settings, checks, series)


def _box_of_air(n: int, advection: Advection) -> SmokeSolver:
    """A closed box of a metre, n cells across, whose warm air rises."""
    return build_box((n, n, n), 1.0 / n, advection=advection, gravity=(0.0, 0.0, -GRAVITY),
                     buoyancy_temperature=GRAVITY / AMBIENT)  # fmt: skip


def _thermal(solver: SmokeSolver) -> dict[str, list[float]]:
    """A round thermal of warm smoke let go in a closed box: how far its centre has risen [m], largest speed [m/s].

    Everything about it is smooth, and it ends before it rolls up into a ring, so grids can resolve it.
    """
    n = solver.grid.cells[0]
    offset = solver.grid.cell_centres() - np.array([0.5, 0.5, THERMAL_HEIGHT])
    blob = np.exp(-(offset**2).sum(axis=1) / THERMAL_RADIUS**2)
    set_flow(solver, np.zeros_like, density=blob, excess_temperature=EXCESS * blob)
    heights = (np.arange(n) + 0.5) / n
    first = float((blob.reshape(n, n, n).sum(axis=(0, 1)) * heights).sum() / blob.sum())
    found: dict[str, list[float]] = {"times": [], "rises": [], "speeds": []}
    span = THERMAL_DURATION / THERMAL_SAMPLES
    for sample in range(1, THERMAL_SAMPLES + 1):
        advance(solver, span, math.ceil(span * THERMAL_STEPS_PER_CELL * n / 2))
        arrays = solver.snapshots()["air"].arrays
        layers = arrays["density"].sum(axis=(0, 1), dtype=np.float64)
        found["times"].append(sample * span)
        found["rises"].append(float((layers * heights).sum() / layers.sum()) - first)
        found["speeds"].append(float(arrays["velocity"][..., 2].max()))
    return found


def _order(thermals: dict[int, dict[str, list[float]]], name: str) -> float:
    """Order by which a number at the end converges: of its differences between the three finest resolutions."""
    coarse, middle, fine = (thermals[n][name][-1] for n in sorted(thermals)[-3:])
    return math.log2(abs(middle - coarse) / abs(fine - middle))


def _halved(thermals: dict[int, dict[str, list[float]]]) -> float:
    middle, fine = (thermals[n]["rises"][-1] for n in sorted(thermals)[-2:])
    return middle / fine


def _warm_ball(solver: SmokeSolver) -> float:
    """Acceleration of the inner half of a warm ball of air let go in a box, over 2/3 of beta (T - T_air).

    Inside, potential theory has it the same everywhere: the ball drives its own air and, as any sphere, half its volume
    of what is around (added mass). Its rim, a cell thick, mixes in the air that flows back beside it.
    """
    distance = np.linalg.norm(solver.grid.cell_centres() - 0.5, axis=1)
    set_flow(solver, np.zeros_like, excess_temperature=np.where(distance < RADIUS, EXCESS, 0.0))
    dt = 1e-3
    solver.substep(dt)
    rise = solver.snapshots()["air"].arrays["velocity"][..., 2].ravel()[distance < 0.5 * RADIUS].mean()
    return float(rise) / dt / (2.0 / 3.0 * GRAVITY / AMBIENT * EXCESS)


def _plume(n: int, advection: Advection, **keys: Any) -> dict[str, Any]:
    """A plume from a ball that emits for the first half of the time: its smoke over what was emitted."""
    source = {"shape": {"type": "sphere", "radius": RADIUS}, "position": (0.5, 0.5, 0.2), "fluctuation": 0.0,
              "temperature": AMBIENT + EXCESS, "end_s": 0.5 * DURATION}  # fmt: skip
    solver = build_box((n, n, round(HEIGHT * n)), 1.0 / n, advection=advection, gravity=(0.0, 0.0, -GRAVITY),
                       buoyancy_temperature=GRAVITY / AMBIENT, source=[source], **keys)  # fmt: skip
    solver.begin_frame(0.0)
    times, kept = [], []
    for sample in range(1, SAMPLES + 1):
        span = DURATION / SAMPLES
        advance(solver, span, max(1, math.ceil(span / min(solver.stable_dt(), 0.25 / n))))
        numbers = solver.diagnostics()
        times.append(sample * span)
        kept.append(numbers["mass"] / numbers["emitted_mass"])
    return {"times": times, "kept": kept, "failed": numbers["not_converged"]}
