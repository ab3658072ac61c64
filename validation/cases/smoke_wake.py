"""Eddies that a cylinder sheds into a wind, as often as measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import SHADES, THEORY, label_axes, make_panels
from validation.scenes import WEIGHTLESS
from validation.smoke_boxes import AMBIENT, Array

PUBLISHED = 0.2  # 0.18 to 0.21 between Reynolds numbers of 200 and 100,000 (Roshko 1954; Norberg 2003)
WIND, DIAMETER = 1.0, 1.0  # [m/s], [m]
UPSTREAM, LENGTH, WIDTH, LAYERS = 3.0, 16.0, 10.0, 2  # of the box [m], and cells along the cylinder
SKIN = 0.75  # thickness of the layer of air that sticks to the cylinder [cells]
KICK, KICK_S = 0.5, 0.5  # velocity across the wind of a blow at first [m/s], which takes so long [s]
PROBE = 1.5  # how far behind the middle of the cylinder the velocity across the wind is looked at [m]
SETTLED = 0.5  # part of the time after which eddies are counted
CELLS_A_STEP = 1.6  # of the wind


def find(_: str, cells: Sequence[int], duration: float) -> Found:
    """Wakes with so many cells across the cylinder, for a time [s]."""
    checks: list[Check] = []
    series: dict[str, Any] = {"cells": list(cells)}
    for n in cells:
        times, across = _wake(n, duration)
        strouhal, spread = _frequency(times, across)
        note = "within a tenth, as required; air slips but for a skin of three quarters of a cell that sticks"
        checks.append(Check(f"Strouhal number of a cylinder of {n} cells", strouhal, PUBLISHED, 0.1 * PUBLISHED, note))
        checks.append(Check(f"spread of its periods over their mean, {n} cells", spread, 0.0, 0.02, "measured"))
        series |= {f"times_{n}": times.tolist(), f"across_{n}": across.tolist(), f"strouhal_{n}": [strouhal]}
    return checks, series


def _wake(n: int, duration: float) -> tuple[Array, Array]:
    """Velocity across the wind behind a cylinder of so many cells [m/s], with its times [s]."""
    from sim.smoke.parameters import SmokeParameters
    from sim.smoke.solver import SmokeSolver

    cell_size, radius = DIAMETER / n, 0.5 * DIAMETER
    depth = LAYERS * cell_size
    low, high = (-UPSTREAM, 0.0, -0.5 * WIDTH), (LENGTH - UPSTREAM, depth, 0.5 * WIDTH)
    still = {"density": 0.0, "temperature": AMBIENT, "fluctuation": 0.0}
    skin = {**_cylinder(radius + SKIN * cell_size, depth), **still, "velocity": (0.0, 0.0, 0.0)}
    kick = {"shape": {"type": "box", "size": (0.5, 1.0, 0.5)}, "position": (1.0, 0.0, 0.5)}
    kick |= {**still, "velocity": (WIND, 0.0, KICK), "end_s": KICK_S}
    air = {"name": "air", "cell_size": cell_size, "open_faces": ("x-", "x+"), "wind": (WIND, 0.0, 0.0), "cfl": 1.0}
    parameters = SmokeParameters.model_validate({**air, "vorticity_confinement": 0.0, "source": [skin, kick]})
    solid = build_solid(Placement.model_validate(_cylinder(radius, depth)))
    solver = SmokeSolver(parameters, domain=DomainParameters(min=low, max=high), gravity=WEIGHTLESS, solids=[solid])
    solver.begin_frame(0.0)
    place = round((UPSTREAM + PROBE) / cell_size), 0, solver.grid.cells[2] // 2
    times, across = [], []
    while solver.time_s < duration:
        solver.substep(min(solver.stable_dt(), cell_size / (CELLS_A_STEP * WIND)))
        times.append(solver.time_s)
        across.append(float(solver.grid.trim(solver.checkpoint()["w_face_z"], solver.grid.face_shape(2))[place]))
    return np.array(times), np.array(across)


def _cylinder(radius: float, depth: float) -> dict[str, Any]:
    shape = {"type": "cylinder", "radius": radius, "height": 4.0 * depth}
    return {"shape": shape, "position": (0.0, 0.5 * depth, 0.0), "rotation_deg": (90.0, 0.0, 0.0)}


def _frequency(times: Array, across: Array) -> tuple[float, float]:
    """Strouhal number, frequency times diameter over the wind, and the spread of periods over their mean [-]."""
    settled = times > SETTLED * times[-1]
    time, value = times[settled], across[settled] - across[settled].mean()
    rising = np.flatnonzero((value[:-1] < 0.0) & (value[1:] >= 0.0))
    part = value[rising] / (value[rising] - value[rising + 1])
    periods = np.diff(time[rising] + part * (time[rising + 1] - time[rising]))
    return float(DIAMETER / (WIND * periods.mean())), float(periods.std() / periods.mean())


def draw(results: Sequence[CaseResult]) -> Figure:
    """Velocity across the wind behind the cylinder over time, and the Strouhal number over the cells across it."""
    figure, (wake, strouhal) = make_panels(2, width=4.2)
    series = results[0].series
    for n, shade in zip(series["cells"], SHADES, strict=False):
        wake.plot(series[f"times_{n}"], series[f"across_{n}"], color=shade, linewidth=1.0, label=f"{n} cells")
    wake.set_ylim(-1.6, 2.2)  # room for the legend above the curves
    label_axes(wake, "time [s]", "velocity across [m/s]", "wake of a cylinder", legend="upper left")
    found = [series[f"strouhal_{n}"][0] for n in series["cells"]]
    strouhal.plot(series["cells"], found, "o-", color=SHADES[0], label="found")
    strouhal.axhspan(0.9 * PUBLISHED, 1.1 * PUBLISHED, color=THEORY, alpha=0.15)
    strouhal.axhline(PUBLISHED, color=THEORY, linestyle="--", label="published, and a tenth of it")
    strouhal.set_ylim(0.0, 0.3)
    label_axes(strouhal, "cells across the cylinder", "Strouhal number", "frequency of eddies")
    return figure


SIZES = {"cells": ((10, 16), (10,)), "duration": (50.0, 40.0)}  # across the cylinder; [s]
CASE = Case(find, draw, solvers=("smoke",), sizes=SIZES)
