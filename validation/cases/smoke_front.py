"""The front of a plume against a refined run: a smooth source, so that grids differ by what they resolve alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from validation.cases import Case, Found
from validation.checks import CaseResult, Check, order_of_differences
from validation.figures import label_axes, make_panels, plot_each
from validation.smoke_boxes import Advection, Array, set_flow, warm_box

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

RADIUS, HEIGHT = 0.1, 0.25  # where the source has fallen to 1/e, and how high above the floor its middle is [m]
SMOKE_RATE, HEAT_RATE = 2.0, 200.0  # of the source's middle [1/s, K/s]
DURATION, SAMPLES, STEPS_PER_CELL = 1.0, 8, 4  # rise [s]; looks at it; steps in which air at 1 m/s crosses a cell


def find(solver: Advection, cells: Sequence[int]) -> Found:
    """How high the front of the plume is at several resolutions, in cells across the box; two have no order."""
    times = [DURATION * sample / SAMPLES for sample in range(1, SAMPLES + 1)]
    fronts = {n: _fronts(n, solver) for n in cells}
    ends = [fronts[n][-1] for n in cells]
    rise = (ends[-2] - HEIGHT) / (ends[-1] - HEIGHT)
    reason = "measured, from the middle of the source; at this order the finest is off by about half as much"
    checks = [
        Check(
            "rise of the front at half the resolution, over that at the finest",
            rise,
            1.0,
            0.03 * 64 / cells[-1],
            reason,
        )
    ]
    if len(cells) > 2:
        reason = "steps are refined with cells: first order in time, second to third in space, which prevails so far"
        checks.append(Check("order of the front's height", order_of_differences(*ends), 2.5, 0.5, reason))
    series: dict[str, Any] = {"cells": list(cells), "times": times, **{f"front_{n}": fronts[n] for n in cells}}
    return checks, series


def _fronts(n: int, advection: Advection) -> list[float]:
    """Heights of the front [m] at the samples.

    A job's source sets what is in its cells, with an edge that is a staircase; this one adds to cells before each step,
    at a rate that falls off as a Gaussian.
    """
    solver = warm_box(n, advection)
    set_flow(solver, np.zeros_like)
    offset = solver.grid.cell_centres() - np.array([0.5, 0.5, HEIGHT])
    blob = np.exp(-(offset**2).sum(axis=1) / RADIUS**2).reshape(solver.grid.cells)
    rate = solver.grid.pad(blob.astype(np.float32))
    steps = math.ceil(DURATION / SAMPLES * STEPS_PER_CELL * n)
    dt = DURATION / SAMPLES / steps
    found = []
    for _ in range(SAMPLES):
        for _ in range(steps):
            state = solver.checkpoint()
            state["density"] = state["density"] + np.float32(dt * SMOKE_RATE) * rate
            state["excess_temperature"] = state["excess_temperature"] + np.float32(dt * HEAT_RATE) * rate
            solver.restore(state)
            solver.substep(dt)
        found.append(_front(solver))
    return found


def _front(solver: SmokeSolver) -> float:
    """How high on the axis the density has fallen to half of its largest there [m], between the middles of cells."""
    n = solver.grid.cells[0]
    density = solver.snapshots()["air"].arrays["density"]
    # Four columns meet at the axis.
    on_axis: Array = density[n // 2 - 1 : n // 2 + 1, n // 2 - 1 : n // 2 + 1].mean(axis=(0, 1), dtype=np.float64)
    half = 0.5 * on_axis.max()
    last = int(np.nonzero(on_axis > half)[0].max())
    part = (on_axis[last] - half) / (on_axis[last] - on_axis[last + 1])
    return float((last + 0.5 + part) / n)


def draw(results: Sequence[CaseResult]) -> Figure:
    """Height of the front of a plume at several resolutions."""
    figure, (front,) = make_panels(1, width=4.2)
    series = results[0].series
    cells = {f"front_{count}": f"{count} cells a metre" for count in series["cells"]}
    plot_each(front, series, "times", cells, marker="o", markersize=3)
    label_axes(front, "time [s]", "height of the front [m]", "plume from a smooth source")
    return figure


CASE = Case(find, draw, solvers=("maccormack",), sizes={"cells": ((16, 32, 64), (24, 48))})
