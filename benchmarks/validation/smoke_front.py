"""The front of a plume against a refined run: a smooth source, so that grids differ by what they resolve alone."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.smoke_boxes import Advection, Array, build_box, set_flow

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

SOLVERS = ("maccormack",)

GRAVITY, AMBIENT = 9.81, 293.0
"""Of the plume [m/s²], and of the air around it [K]."""

RADIUS, HEIGHT = 0.1, 0.25
"""Where the source has fallen to 1/e, and how high above the floor its middle is [m]."""

SMOKE_RATE, HEAT_RATE = 2.0, 200.0
"""Of the source's middle [1/s, K/s]."""

CELLS, QUICK_CELLS = (16, 32, 64), (24, 48)
"""Across the closed box of 1 m."""

DURATION, SAMPLES, STEPS_PER_CELL = 1.0, 8, 4
"""How long it rises [s], how often it is looked at, and steps in which air at 1 m/s crosses a cell."""


def run(solver: Advection, *, quick: bool = False) -> CaseResult:
    """How high the front of the plume is at several resolutions; quick: at two, which have no order."""
    counts = QUICK_CELLS if quick else CELLS
    times = [DURATION * sample / SAMPLES for sample in range(1, SAMPLES + 1)]
    fronts = {n: _fronts(n, solver) for n in counts}
    ends = [fronts[n][-1] for n in counts]
    checks = [
        Check("rise of the front at half the resolution, over that at the finest",
              (ends[-2] - HEIGHT) / (ends[-1] - HEIGHT), 1.0, 0.1,
              "measured, from the middle of the source; at this order the finest is off by about half as much")
    ]  # fmt: skip
    if not quick:
        order = math.log2(abs(ends[-2] - ends[-3]) / abs(ends[-1] - ends[-2]))
        checks.append(
            Check("order of the front's height", order, 1.5, 0.5,
                  "steps are refined with cells: first order in time and second in space, of which neither prevails")
        )  # fmt: skip
    series: dict[str, Any] = {"cells": list(counts), "times": times, **{f"front_{n}": fronts[n] for n in counts}}
    settings = {"radius_m": RADIUS, "height_m": HEIGHT, "smoke_rate_1_s": SMOKE_RATE, "heat_rate_k_s": HEAT_RATE}
    return CaseResult("smoke-front", solver, settings, checks, series)


def _fronts(n: int, advection: Advection) -> list[float]:
    """Heights of the front [m] at the samples.

    A job's source sets what is in its cells, with an edge that is a staircase; this one adds to cells before each step,
    at a rate that falls off as a Gaussian.
    """
    solver = build_box((n, n, n), 1.0 / n, advection=advection, gravity=(0.0, 0.0, -GRAVITY),
                       buoyancy_temperature=GRAVITY / AMBIENT)  # fmt: skip
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
