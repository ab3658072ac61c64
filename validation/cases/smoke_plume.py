"""Smoke that rises: how a warm ball starts, a thermal at each resolution, and whether a plume's mass is kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from sim.shapes.parameters import Placement, SphereShape
from sim.shapes.placement import build_solid
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, order_of_differences
from validation.figures import label_axes, make_panels, plot_each
from validation.scenes import GRAVITY
from validation.smoke_boxes import AMBIENT, Advection, ball_source, set_flow, take_steps, warm_box

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

EXCESS = 60.0  # temperature of the source and of the ball above the air's [K]
RADIUS = 0.1  # of the ball in the middle of the closed box of 1 m, and of the source [m]
THERMAL_RADIUS, THERMAL_HEIGHT = 0.15, 0.4  # where its heat has fallen to 1/e, and how high it begins [m]
THERMAL_DURATION, THERMAL_SAMPLES, THERMAL_STEPS_PER_CELL = 0.5, 5, 4  # [s]; looks at it; steps a cell at 1 m/s
AROUND_CELLS, HEIGHT = 24, 1.5  # cells a metre of the plume past a ball, and height of the plumes' boxes [m]
DURATION, SAMPLES = 1.4, 14  # how long a plume rises [s], and how often its smoke is summed up

OBSTACLE = Placement(shape=SphereShape(type="sphere", radius=0.15), position=(0.5, 0.5, 0.7))


def find(solver: Advection, cells: Sequence[int], ball_cells: int, closed_cells: int) -> Found:
    """Warm ball, a thermal at several resolutions, mass in a closed box and past an obstacle in an open one."""
    thermals = {n: _thermal_at_no_step(n, solver) for n in cells}
    ball = _warm_ball(warm_box(ball_cells, solver))
    closed = _plume(closed_cells, solver)
    around = _plume(AROUND_CELLS, solver, solids=[build_solid(OBSTACLE)], open_faces=("x-", "x+", "y-", "y+"))
    checks = [
        Check("acceleration in the middle of a warm ball over 2/3 of its buoyancy", ball, 1.0, 0.02,
              "it drives half its volume of air around it; cubes for a ball, and walls five radii away"),
        Check("order of the rise of a thermal", _order(thermals, "rises"), 2.0, 0.35,
              "in space: smoke moves by the velocity of a step's end, and what that gives to first order is taken off"),
        Check("order of its largest speed", _order(thermals, "speeds"), 1.75, 0.45,
              "second in space, but of a maximum, which cells hit or miss"),
        Check("rise of the thermal at half the resolution, over that at the finest", _halved(thermals), 1.0,
              0.005 * max(1.0, 64 / cells[-1]) ** 2,
              "converged: at this order the finest is a quarter as far from the limit"),
    ]  # fmt: skip
    checks += [
        Check(f"smoke {name} over what was emitted", plume["kept"][-1], 1.0, 0.01, "required: fluxes keep it")
        for name, plume in (("in a closed box", closed), ("past a ball in an open box", around))
    ]
    failed = sum(plume["failed"] for plume in (closed, around))
    checks.append(Check("projections that did not converge", failed, 0.0, 0.0, "a count"))
    series: dict[str, Any] = {"cells": list(cells), "thermal_times": thermals[cells[0]]["times"]}
    series |= {"times": closed["times"], "kept_closed": closed["kept"], "kept_around": around["kept"]}
    series |= {f"rises_{n}": thermal["rises"] for n, thermal in thermals.items()}
    return checks, series


def _thermal_at_no_step(n: int, advection: Advection) -> dict[str, list[float]]:
    """A thermal at so many cells a metre, extrapolated from two lengths of step to none (Richardson)."""
    whole, halves = (_thermal(warm_box(n, advection), parts) for parts in (1, 2))
    return {key: [2.0 * b - a for a, b in zip(whole[key], halves[key], strict=True)] for key in whole}


def _thermal(solver: SmokeSolver, parts: int) -> dict[str, list[float]]:
    """A round thermal of warm smoke let go in a closed box: how far its centre has risen [m], largest speed [m/s].

    Everything about it is smooth, and it ends before it rolls up into a ring, so grids can resolve it. Its steps are
    in so many parts.
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
        take_steps(solver, span, parts * math.ceil(span * THERMAL_STEPS_PER_CELL * n / 2))
        arrays = solver.snapshots()["air"].arrays
        layers = arrays["density"].sum(axis=(0, 1), dtype=np.float64)
        found["times"].append(sample * span)
        found["rises"].append(float((layers * heights).sum() / layers.sum()) - first)
        found["speeds"].append(float(arrays["velocity"][..., 2].max()))
    return found


def _order(thermals: dict[int, dict[str, list[float]]], name: str) -> float:
    """Order by which a number at the end converges: of its differences between the three finest resolutions."""
    return order_of_differences(*(thermals[n][name][-1] for n in sorted(thermals)[-3:]))


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
    source = ball_source(0.2, RADIUS, EXCESS, 0.5 * DURATION)
    solver = warm_box(n, advection, height=HEIGHT, source=[source], **keys)
    solver.begin_frame(0.0)
    times, kept = [], []
    for sample in range(1, SAMPLES + 1):
        span = DURATION / SAMPLES
        take_steps(solver, span, max(1, math.ceil(span / min(solver.stable_dt(), 0.25 / n))))
        numbers = solver.diagnostics()
        times.append(sample * span)
        kept.append(numbers["mass"] / numbers["emitted_mass"])
    return {"times": times, "kept": kept, "failed": numbers["not_converged"]}


def draw(results: Sequence[CaseResult]) -> Figure:
    """Rise of a thermal at several resolutions, and smoke over what was emitted."""
    figure, (rise, kept) = make_panels(2, width=4.2)
    series = results[0].series
    cells = {f"rises_{count}": f"{count} cells a metre" for count in series["cells"]}
    plot_each(rise, series, "thermal_times", cells, marker="o", markersize=3)
    label_axes(rise, "time [s]", "rise of its centre [m]", "thermal")
    plot_each(kept, series, "times", {"kept_closed": "closed box", "kept_around": "open box, past a ball"})
    kept.axhspan(0.99, 1.01, color="#eeeeee", zorder=0)
    kept.set_ylim(0.97, 1.03)
    label_axes(kept, "time [s]", "smoke / emitted smoke", "balance; grey: 1 %")
    return figure


SIZES = {"cells": ((16, 32, 64, 128), (12, 24, 48)), "ball_cells": (48, 48), "closed_cells": (32, 16)}
CASE = Case(find, draw, solvers=("maccormack",), sizes=SIZES)
