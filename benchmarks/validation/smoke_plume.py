"""Smoke that rises: how a warm ball starts, how high a plume is at each resolution, and whether its mass is kept."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.smoke_boxes import Advection, advance, build_box, set_flow
from sim.shapes import build_solid
from sim.shapes.parameters import Placement, SphereShape

SOLVERS = ("maccormack",)

GRAVITY = 9.81
EXCESS, AMBIENT = 60.0, 293.0
"""Temperature of the source and of the ball above the air's, and the air's [K]."""

BALL_CELLS, RADIUS = 48, 0.1
"""Across the closed box of 1 m, and radius of the ball in its middle [m]."""

CELLS, HEIGHT = (16, 24, 32), 1.5
"""Cells a metre, and height of the box of the plume [m]."""

DURATION, SAMPLES, FRONT = 1.4, 14, 0.95
"""How long the plume rises [s], how often its front is read, and what part of the smoke is below that."""

OBSTACLE = Placement(shape=SphereShape(type="sphere", radius=0.15), position=(0.5, 0.5, 0.7))


def run(solver: Advection, *, quick: bool = False) -> CaseResult:
    """Warm ball, fronts at several resolutions, mass in a closed box and past an obstacle in an open one."""
    counts = CELLS[::2] if quick else CELLS
    plumes = {n: _plume(n, solver) for n in counts}
    closed = plumes[counts[-1]]
    around = _plume(24, solver, solids=[build_solid(OBSTACLE)], open_faces=("x-", "x+", "y-", "y+"))
    checks = [
        Check("acceleration in the middle of a warm ball over 2/3 of its buoyancy", _warm_ball(solver), 1.0, 0.02,
              "it drives half its volume of air around it; cubes for a ball, and walls five radii away"),
    ]  # fmt: skip
    checks += [
        Check(f"smoke {name} over what was emitted", plume["kept"][-1], 1.0, 0.01, "required: corrections are balanced")
        for name, plume in (("in a closed box", closed), ("past a ball in an open box", around))
    ]
    checks.append(
        Check("projections that did not converge", sum(plume["failed"] for plume in [*plumes.values(), around]), 0.0,
              0.0, "a count")
    )  # fmt: skip
    series: dict[str, Any] = {"cells": list(counts), "times": closed["times"], "kept_closed": closed["kept"],
                              "kept_around": around["kept"]}  # fmt: skip
    series |= {f"fronts_{n}": plume["fronts"] for n, plume in plumes.items()}
    settings = {"excess_k": EXCESS, "radius_m": RADIUS, "height_m": HEIGHT, "duration_s": DURATION, "front": FRONT}
    return CaseResult("smoke-plume", solver, settings, checks, series)


def _warm_ball(advection: Advection) -> float:
    """Acceleration of the inner half of a warm ball of air let go in a box, over 2/3 of beta (T - T_air).

    Inside, potential theory has it the same everywhere: the ball drives its own air and, as any sphere, half its volume
    of what is around (added mass). Its rim, a cell thick, mixes in the air that flows back beside it.
    """
    n = BALL_CELLS
    solver = build_box((n, n, n), 1.0 / n, advection=advection, gravity=(0.0, 0.0, -GRAVITY),
                       buoyancy_temperature=GRAVITY / AMBIENT)  # fmt: skip
    distance = np.linalg.norm(solver.grid.cell_centres() - 0.5, axis=1)
    set_flow(solver, np.zeros_like, excess_temperature=np.where(distance < RADIUS, EXCESS, 0.0))
    dt = 1e-3
    solver.substep(dt)
    rise = solver.snapshots()["air"].arrays["velocity"][..., 2].ravel()[distance < 0.5 * RADIUS].mean()
    return float(rise) / dt / (2.0 / 3.0 * GRAVITY / AMBIENT * EXCESS)


def _plume(n: int, advection: Advection, **keys: Any) -> dict[str, Any]:
    """A plume from a ball that emits for the first half of the time: front [m], and mass over what was emitted."""
    source = {"shape": {"type": "sphere", "radius": RADIUS}, "position": (0.5, 0.5, 0.2), "fluctuation": 0.0,
              "temperature": AMBIENT + EXCESS, "end_s": 0.5 * DURATION}  # fmt: skip
    solver = build_box((n, n, round(HEIGHT * n)), 1.0 / n, advection=advection, gravity=(0.0, 0.0, -GRAVITY),
                       buoyancy_temperature=GRAVITY / AMBIENT, source=[source], **keys)  # fmt: skip
    solver.begin_frame(0.0)
    heights = solver.grid.cell_size * np.arange(1, round(HEIGHT * n) + 1)
    times, fronts, kept = [], [], []
    for sample in range(1, SAMPLES + 1):
        span = DURATION / SAMPLES
        advance(solver, span, max(1, math.ceil(span / min(solver.stable_dt(), 0.25 / n))))
        layers = solver.snapshots()["air"].arrays["density"].sum(axis=(0, 1), dtype=np.float64)
        below = np.cumsum(layers) / layers.sum()
        numbers = solver.diagnostics()
        times.append(sample * span)
        fronts.append(float(np.interp(FRONT, below, heights)))
        kept.append(numbers["mass"] / numbers["emitted_mass"])
    return {"times": times, "fronts": fronts, "kept": kept, "failed": numbers["not_converged"]}
