"""Whether smoke is kept where the scheme does not keep it exactly: through open sides, and around a moving ball."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import SHADES, THEORY, label_axes, make_panels, plot_each
from validation.smoke_boxes import Advection, ball_source, build_box, faces_of, set_flow, warm_box

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

EXCESS = 100.0  # temperature of the source above the air's [K]
OPEN = ("x-", "x+", "y-", "y+", "z+")  # all sides but the floor
CELLS, BLOB_CELLS = 20, (20, 40)  # across the boxes of a metre, and of those that wind blows through
BLOB, WIND, WIND_DURATION = 0.15, 1.0, 1.2  # radius where the smoke has fallen to 1/e [m]; [m/s]; [s]
LEAVING_DURATION, STIRRED_DURATION = 2.5, 2.0  # of a plume through the top, of a ball in smoke [s]
BALL_SPEED = 0.3  # [m/s]; it crosses a bit more than half of the box


def find(solver: Advection) -> Found:
    """Smoke that wind blows out, a plume that leaves through the top, and a ball that goes through smoke."""
    boxes = {n: build_box((n, n, n), 1.0 / n, advection=solver, open_faces=OPEN) for n in BLOB_CELLS}
    blown = {n: _blown(box) for n, box in boxes.items()}
    leaving = _leaving(solver)
    stirred = _stirred()
    coarse, fine = (_largest_error(each) for each in blown.values())
    far = _largest_error(_blown(boxes[BLOB_CELLS[0]], cells_a_step=1.5))
    checks = [
        Check(f"error of the smoke left of a blob that wind blows out, {BLOB_CELLS[0]} cells", coarse, 0.0, 0.03,
              "over that of the start; its radius is three cells, and the limiter cuts its crest"),
        Check(f"error of the smoke left of a blob that wind blows out, {BLOB_CELLS[1]} cells", fine, 0.0, 0.006,
              "likewise, of six cells"),
        Check(f"error of the smoke left of a blob blown out, {BLOB_CELLS[0]} cells, 1.5 of them a step", far, 0.0, 0.02,
              "a step of more than a cell is divided"),
        Check("smoke that is left after it has passed", blown[BLOB_CELLS[1]]["kept"][-1], 0.0, 0.001,
              "none comes back"),
        Check("smoke of an open box and what left it over what was emitted", leaving["balance"][-1], 1.0, 0.01,
              "what left is found from the smoke at each step's start"),
        Check("smoke around a moving ball over what was emitted", stirred["kept"][-1], 1.0, 0.005,
              "second order of the step at its sides, where it covers a tenth of the smoke on its way; measured"),
    ]  # fmt: skip
    series = {
        **{f"blown_{name}_{n}": values for n, each in blown.items() for name, values in each.items()},
        **{f"leaving_{name}": values for name, values in leaving.items()},
        **{f"stirred_{name}": values for name, values in stirred.items()},
    }
    return checks, series


def _blown(solver: SmokeSolver, *, cells_a_step: float = 0.5) -> dict[str, list[float]]:
    """A blob in even wind in a box: its smoke over that of the start, by advection alone."""
    distance = ((solver.grid.cell_centres() - 0.5) ** 2).sum(axis=1)
    blob = np.exp(-distance / BLOB**2)
    set_flow(solver, lambda positions: np.tile([WIND, 0.0, 0.0], (len(positions), 1)), density=blob)
    start, dt = solver.diagnostics()["mass"], cells_a_step * solver.grid.cell_size / WIND
    blown: dict[str, list[float]] = {"times": [], "kept": [], "exact": []}
    scale = math.erf(0.5 / BLOB)
    for step in range(1, round(WIND_DURATION / dt) + 1):
        solver._transport.advance(cells_a_step / WIND)
        blown["times"].append(step * dt)
        blown["kept"].append(solver.diagnostics()["mass"] / start)
        # The blob is cut off at the walls at first, and what was beyond the windward side does not come in.
        gone = WIND * step * dt
        blown["exact"].append(max(0.0, math.erf((0.5 - gone) / BLOB) + scale) / (2.0 * scale))
    return blown


def _leaving(advection: Advection) -> dict[str, list[float]]:
    """A plume out of the top of an open box: its smoke, and with what left it, over what was emitted."""
    n = CELLS
    source = ball_source(0.25, 0.15, EXCESS, 0.5 * LEAVING_DURATION)
    solver = warm_box(n, advection, source=[source], open_faces=OPEN)
    solver.begin_frame(0.0)
    left = 0.0
    leaving: dict[str, list[float]] = {"times": [], "kept": [], "balance": []}
    while solver.time_s < LEAVING_DURATION:
        dt = min(solver.stable_dt(), 0.25 / n)
        left += _outflow(solver, dt)
        solver.substep(dt)
        numbers = solver.diagnostics()
        leaving["times"].append(solver.time_s)
        leaving["kept"].append(numbers["mass"] / numbers["emitted_mass"])
        leaving["balance"].append((numbers["mass"] + left) / numbers["emitted_mass"])
    return leaving


def _largest_error(blown: dict[str, list[float]]) -> float:
    return float(np.abs(np.subtract(blown["kept"], blown["exact"])).max())


def _outflow(solver: Any, dt: float) -> float:
    """Smoke that flows out through the sides of the box in a step [m³]: the last cell's share that crosses in it."""
    density = solver.snapshots()["air"].arrays["density"].astype(np.float64)
    total = 0.0
    for axis, face in enumerate(faces_of(solver)):
        speed, values = np.moveaxis(face, axis, 0), np.moveaxis(density, axis, 0)
        for outward, last in ((-speed[0], values[0]), (speed[-1], values[-1])):
            total += float((np.maximum(outward, 0.0) * last).sum())
    return total * dt * solver.grid.cell_size**2


def _stirred() -> dict[str, list[float]]:
    """A ball that moves through a cloud in a closed box: its smoke over what was emitted."""
    from sim.build import build_world

    source = {"shape": {"type": "sphere", "radius": 0.25}, "position": (0.5,) * 3, "fluctuation": 0.0, "end_s": 0.3}
    ball = {"name": "ball", "kind": "kinematic", "shape": {"type": "sphere", "radius": 0.12}}
    ball |= {"position": (0.2, 0.5, 0.5), "velocity": (BALL_SPEED, 0.0, 0.0)}
    smoke = {"name": "air", "cell_size": 1.0 / CELLS, "open_faces": (), "source": [source], "cooling": 0.0}
    scene = {"domain": {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)}, "rigid": [ball], "smoke": [smoke]}
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=30.0)
    found: dict[str, list[float]] = {"times": [], "kept": []}
    for _ in range(round(30 * STIRRED_DURATION)):
        report = world.advance_frame()
        numbers = report.diagnostics["air"]
        found["times"].append(report.time_s)
        found["kept"].append(numbers["mass"] / numbers["emitted_mass"])
    return found


def draw(results: Sequence[CaseResult]) -> Figure:
    """Smoke left in an even wind, balance of a plume that leaves, smoke around a moving ball."""
    figure, (blown, leaving, stirred) = make_panels(3)
    series = results[0].series
    for n, shade in zip(BLOB_CELLS, SHADES, strict=False):
        blown.plot(series[f"blown_times_{n}"], series[f"blown_kept_{n}"], color=shade, label=f"{n} cells")
    blown.plot(series[f"blown_times_{n}"], series[f"blown_exact_{n}"], ":", color=THEORY, label="exact")
    label_axes(blown, "time [s]", "smoke / at first", "blob in even wind")
    plot_each(leaving, series, "leaving_times", {"leaving_kept": "in the box", "leaving_balance": "and what left"})
    plot_each(stirred, series, "stirred_times", {"stirred_kept": "in the box"})
    for axes, title in ((leaving, "plume, open box"), (stirred, "moving ball, closed box")):
        axes.set_ylim(bottom=0.0)
        label_axes(axes, "time [s]", "smoke / emitted smoke", title)
    return figure


CASE = Case(find, draw, solvers=("maccormack",))
