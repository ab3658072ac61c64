"""A column of water, twice as high as wide, that collapses: how far its front has run."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import TITLES, CaseResult, Check
from validation.figures import FINER, THEORY, label_axes, make_panels, style_of
from validation.scenes import GRAVITY, lattice, make_fluid, recorded, state_of

REFERENCE = Path(__file__).resolve().parents[2] / "tests" / "reference" / "dam_break_front.csv"
WIDTH = 0.2  # of the column [m], which is twice as high; the front never reaches the end of the channel
LAYERS_ACROSS = 6  # the channel's width in particles; its walls are smooth, so that the flow is plane
COMPARED = (0.5, 3.0)  # span of T in which the deviations are taken: later the front is a film thinner than a particle
AHEAD = 0.0025  # share of the water that is ahead of what counts as the front, at every resolution


def collapse(solver: str, columns: int, longest: float) -> dict[str, Any]:
    """The front of a dam of so many particles' width over dimensionless time."""
    spacing = WIDTH / columns
    depth = LAYERS_ACROSS * spacing
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=((2.5 + 2.0 * longest) * WIDTH, depth, 3.0 * WIDTH))
    column = lattice((0.0, 0.0, 0.0), (WIDTH, depth, 2.0 * WIDTH), spacing)
    fluid = make_fluid(solver, domain, column, spacing=spacing)
    scale = np.sqrt(2.0 * GRAVITY / WIDTH)
    found = recorded(
        fluid,
        longest / scale,
        cuts=round(20 * longest),
        fronts=lambda: (np.quantile(state_of(fluid)[0][:, 0], 1.0 - AHEAD) + spacing / 2.0) / WIDTH,
    )
    return {
        "times": [0.0, *(time * scale for time in found["times"])],
        "fronts": [1.0, *found["fronts"]],
        "wall_contacts": fluid.diagnostics()["wall_contacts"],
    }


def experiments() -> dict[str, np.ndarray]:
    """Measured fronts by series: T and Z, (2, n)."""
    with REFERENCE.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    names = dict.fromkeys(row["series"] for row in rows)
    return {
        name: np.array([(float(row["T"]), float(row["Z"])) for row in rows if row["series"] == name]).T
        for name in names
    }


def deviations(times: list[float], fronts: list[float], *, shift: float = 0.0) -> np.ndarray:
    """Computed over measured front, less 1, at every measured point in the compared span.

    The experiments are taken to have begun later in T by a shift.
    """
    measured = _measured(*COMPARED)
    return np.interp(measured[0] - shift, times, fronts) / measured[1] - 1.0


def _measured(first: float, last: float) -> np.ndarray:
    """All measured points between two T, (2, n)."""
    points = np.concatenate(list(experiments().values()), axis=1)
    return points[:, (points[0] > first) & (points[0] < last)]


def _best_shift(times: list[float], fronts: list[float]) -> float:
    """The shift in T with the least mean square of the deviations."""
    shifts = np.linspace(0.0, 0.6, 121)
    return float(shifts[np.argmin([(deviations(times, fronts, shift=shift) ** 2).mean() for shift in shifts])])


def find(solver: str, columns: Sequence[int], longest: float) -> Found:
    """The dam, so many particles wide, against the three experiments, up to T = t sqrt(2 g / width)."""
    runs = [collapse(solver, count, longest) for count in columns]
    curve = runs[-1]["times"], runs[-1]["fronts"]
    relative, shift = deviations(*curve), _best_shift(*curve)
    times, fronts = np.array(curve)
    late = (times > 1.5) & (times < COMPARED[1])
    speed = float(np.polyfit(times[late], fronts[late], 1)[0])
    measured_speed = float(np.polyfit(*_measured(1.5, COMPARED[1]), 1)[0])
    checks = [
        Check("front over the measured one, less 1: mean of all points", float(relative.mean()), 0.0, 0.12,
              "the experiments lift a gate and have rough walls, the computation has neither: it leads"),
        Check("the largest of these in size", float(np.abs(relative).max()), 0.0, 0.2,
              "likewise; the experiments themselves differ by 11 % (Z = 3.00 and 3.33 at T = 2.7)"),
        Check("by how much in T the experiments seem to begin later", shift, 0.0, 0.35,
              "20 ms for the 57 mm column: the time in which a gate is lifted"),
        Check("largest deviation after that shift", float(np.abs(deviations(*curve, shift=shift)).max()), 0.0, 0.12,
              "what the experiments differ by, 11 %, and 1 % for the reading of their figures"),
        Check("speed of the front, dZ/dT for 1.5 < T < 3, over the measured one", speed / measured_speed, 1.0, 0.15,
              "no offset in time matters here; walls without friction let it run faster"),
        Check("particles put back by a wall", runs[-1]["wall_contacts"], 0.0, 0.0, "a count"),
    ]  # fmt: skip
    series: dict[str, Any] = {"columns": list(columns)}
    for count, each in zip(columns, runs, strict=True):
        series |= {f"{name}_{count}": each[name] for name in ("times", "fronts")}
        series[f"mean_deviation_{count}"] = float(deviations(each["times"], each["fronts"]).mean())
    return checks, series


def draw(results: Sequence[CaseResult]) -> Figure:
    """Fronts of all solvers and experiments, and of one solver at all resolutions."""
    figure, (solvers, resolutions) = make_panels(2, width=4.2, height=3.2)
    marks = (("s", "Martin & Moyce, 2.25 in"), ("o", "Martin & Moyce, 1.125 in"), ("v", "Koshizuka & Oka"))
    for axes in (solvers, resolutions):
        for (times, fronts), (mark, name) in zip(experiments().values(), marks, strict=True):
            axes.plot(times, fronts, mark, color=THEORY, markersize=4, fillstyle="none", label=name)
        axes.set_xlim(0.0, 4.0)
        axes.set_ylim(1.0, 6.5)
    for result in results:
        finest = max(result.series["columns"])
        solvers.plot(result.series[f"times_{finest}"], result.series[f"fronts_{finest}"], **style_of(result))
    series = results[0].series
    for count, shade in zip(series["columns"], FINER, strict=True):
        resolutions.plot(series[f"times_{count}"], series[f"fronts_{count}"], color=shade, label=f"width / {count}")
    label_axes(solvers, "T = t (2 g / width)^(1/2)", "front / width", f"solvers, spacing width / {finest}")
    label_axes(resolutions, "T", "front / width", f"{TITLES[results[0].solver]}, refinement")
    return figure


CASE = Case(find, draw, sizes={"columns": ((10, 20, 40), (12,)), "longest": (4.0, 3.0)})
