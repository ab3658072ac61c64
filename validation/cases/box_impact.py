"""A dam break that hits a box: pressures on its face against those that MARIN measured (Kleefsman et al. 2005)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import THEORY, label_axes, make_panels, style_of
from validation.scenes import advance, wall_forces

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid

REFERENCE = Path(__file__).resolve().parents[2] / "tests" / "reference" / "box_impact.csv"
TANK, WATER_LENGTH, WATER_DEPTH = (3.22, 1.0, 1.0), 1.228, 0.55  # [m]
BOX, FACE = (0.161, 0.403, 0.161), 2.3955  # size of the box, and how far its face is from the wall behind the water [m]
HEIGHTS = (0.021, 0.061, 0.101, 0.141)  # of the sensors [m]
COLUMNS = ("times", "P1", "P2", "P3", "P4")  # of a record
PATCH = 0.04, 0.2  # height and width of what counts as a sensor: a few particles, in the plane part of the flow [m]
ARRIVAL = 1000.0  # pressure from which on water has reached a sensor [Pa]
FIRST, CUT = 0.36, 0.0025  # from when on, and how often, pressures are taken [s]
MEAN_OF = 4  # samples of the running mean that is drawn
COMPARED = (0.06, 0.28)  # span after the first contact in which they are averaged [s]

IDEAL = (
    "free streamlines of a jet as thick as 0.6 of the box's height have 0.77 of the foot's pressure at 0.101 m, "
    "0.49 at 0.141 m, the record 0.85 and 0.78: what holds the water back there is not in an ideal flow"
)
BOUNDS = ((0.2, "a few particles make a sensor up"), (0.3, "likewise"), (0.4, IDEAL), (0.75, IDEAL))  # by sensor


def measured() -> np.ndarray:
    """Times [s] and the four pressures [Pa], (n, 5)."""
    with REFERENCE.open(encoding="utf-8") as lines:
        rows = csv.reader(line for line in lines if not line.startswith("#"))
        next(rows)
        return np.array([[float(value) for value in row] for row in rows])


def hit(solver: str, spacing: float, end: float) -> np.ndarray:
    """The impact until a time [s], at a spacing of the particles [m]: times [s] and the four pressures [Pa], (n, 5)."""
    from sim.build import build_world
    from sim.scene import SceneParameters

    length, depth = (round(each / spacing) * spacing for each in (WATER_LENGTH, WATER_DEPTH))
    half = TANK[1] / 2.0
    box = {"name": "box", "shape": {"type": "box", "size": BOX}, "position": (FACE + BOX[0] / 2.0, 0.0, BOX[2] / 2.0)}
    water = {"shape": {"type": "box", "size": (length, TANK[1], depth)}, "position": (length / 2.0, 0.0, depth / 2.0)}
    scene = {
        "domain": {"min": (0.0, -half, 0.0), "max": (TANK[0], half, TANK[2])},
        "rigid": [box],
        "fluid": [{"name": "water", "solver": solver, "particle_radius": spacing / 2.0, "block": [water]}],
    }
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=60.0)
    fluid = world.solvers["water"]
    sensors = _sensors(fluid, spacing)
    found = []
    for time in advance(fluid, end, cuts=round(end / CUT)):
        if time < FIRST:
            continue
        pushes = wall_forces(fluid)[1]
        found.append([time, *((pushes[each, 0].sum() / area) for each, area in sensors)])
    return np.array(found)


def _sensors(fluid: SPHFluid, spacing: float) -> list[tuple[np.ndarray, float]]:
    """Samples of the box that make each sensor up, and the area that they stand for [m²].

    They lie up to a spacing inside of it, not evenly: their shares of the face are as their volumes.
    """
    fixed = slice(fluid.boundary.fixed_count)
    x, y, z = fluid.boundary.samples.position.to_numpy()[fixed].T
    share = fluid.boundary.samples.volume.to_numpy()[fixed]
    on_face = (x > FACE) & (x < FACE + 1.2 * spacing) & (abs(y) < PATCH[1] / 2.0) & (z > 0.0) & (z < BOX[2])
    share = share * PATCH[1] * BOX[2] / share[on_face].sum()
    near = [np.flatnonzero(on_face & (abs(z - height) < PATCH[0] / 2.0)) for height in HEIGHTS]
    return [(each, float(share[each].sum())) for each in near]


def arrivals(record: np.ndarray) -> np.ndarray:
    """When water reaches each sensor [s], (4,); infinite where it does not."""
    reached = record[:, 1:] > ARRIVAL
    return np.where(reached.any(axis=0), record[reached.argmax(axis=0), 0], np.inf)


def means(record: np.ndarray) -> np.ndarray:
    """Mean pressures of a span after the first contact [Pa], (4,)."""
    since = record[:, 0] - arrivals(record)[0]
    times = np.linspace(*COMPARED, 200)
    return np.array([np.interp(times, since, record[:, 1 + sensor]).mean() for sensor in range(len(HEIGHTS))])


def find(solver: str, spacing: Sequence[float], end: float) -> Found:
    """The impact at several spacings."""
    runs, record = [hit(solver, each, end) for each in spacing], measured()
    finest = runs[-1]
    first, later = arrivals(finest)[0], arrivals(finest) - arrivals(record)
    ratio = means(finest) / means(record)
    checks = [
        Check("first contact over the measured one", first / arrivals(record)[0], 1.0, 0.08,
              "20 ms at all resolutions and with all solvers; the clock of the record starts with a gate"),
        Check("how much longer than measured the water takes from the first to the third sensor", later[2] - later[0],
              0.0, 0.03, "the time in which the front comes a few spacings farther", "s"),
        *(Check(f"mean pressure at {height:g} m over the measured one", float(each), 1.0, *bound)
          for height, each, bound in zip(HEIGHTS, ratio, BOUNDS, strict=True)),
    ]  # fmt: skip
    return checks, {"spacing": list(spacing)} | {
        f"{name}_{each:g}": run[:, column].tolist()
        for each, run in zip(spacing, runs, strict=True)
        for column, name in enumerate(COLUMNS)
    }


def draw(results: Sequence[CaseResult]) -> Figure:
    """The four pressures over the time since the first contact, means of 10 ms."""
    figure, panels = make_panels(4)
    record = measured()
    for sensor, (axes, height) in enumerate(zip(panels, HEIGHTS, strict=True), start=1):
        axes.plot(record[:, 0] - arrivals(record)[0], record[:, sensor] / 1000.0, color=THEORY, label="MARIN")
        for result in results:
            times, *pressures = (np.array(result.series[f"{name}_{min(result.series['spacing']):g}"])
                                 for name in COLUMNS)  # fmt: skip
            since = times - arrivals(np.stack([times, *pressures], axis=1))[0]
            mean = np.convolve(pressures[sensor - 1], np.full(MEAN_OF, 1.0 / MEAN_OF), mode="same")
            axes.plot(since, mean / 1000.0, linewidth=0.8, **style_of(result))
        label_axes(axes, "time since the first contact [s]", "pressure [kPa]", f"{height:g} m above the floor")
    return figure


CASE = Case(find, draw, sizes={"spacing": ((0.03, 0.02), (0.04,)), "end": (0.7, 0.7)})
