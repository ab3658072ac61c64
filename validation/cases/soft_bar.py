"""A bar of jelly that is clamped at one end and let go: how far it sags, and how fast it swings."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import eigh

from sim.build import build_world
from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import FINER, THEORY, label_axes, make_panels
from validation.scenes import advance

YOUNG, POISSON, DENSITY = 1.0e5, 0.3, 1000.0  # of the bar [Pa], [-], [kg/m³]
THICKNESS, SLENDERNESS = 0.04, 6.0  # edge of its square section [m]; length over that [-]
GRAVITY = 0.2  # so weak that it sags by a thirtieth of its length [m/s²]
PERIODS, CUTS = 0.62, 40  # of the first mode, computed and looked at
ELEMENTS = 60  # of the beam that the frequency is found with
SHEAR = 10.0 * (1.0 + POISSON) / (12.0 + 11.0 * POISSON)
"""Of a rectangular section: mean over largest shear strain (Cowper 1966) [-]."""

LENGTH = SLENDERNESS * THICKNESS
AREA, INERTIA = THICKNESS**2, THICKNESS**4 / 12.0
BENDING, SHEARING = YOUNG * INERTIA, SHEAR * YOUNG / (2.0 * (1.0 + POISSON)) * AREA


def find(_: str, cells: tuple[int, ...]) -> Found:
    """Sag and frequency at each number of cells across the bar, and the way of its end."""
    series: dict[str, Any] = {"cells": list(cells)}
    checks: list[Check] = []
    frequency = _frequency()
    for number in cells:
        times, ways, place = _swing(number, PERIODS / frequency)
        lowest = int(np.argmin(ways))
        near = slice(max(0, lowest - 3), lowest + 4)
        bend, slope, level = np.polyfit(times[near], ways[near], 2)
        turned = -0.5 * slope / bend
        sag = -0.5 * float(np.polyval((bend, slope, level), turned))  # it swings from rest to twice as far
        series[f"times_{number}"], series[f"ways_{number}"] = times, 1e3 * ways
        if number == cells[-1]:
            within, why = 0.24 / number, "the clamp holds to half a cell, and that is so much of the length"
            checks = [
                Check(f"sag of the end over theory, {number} cells across", sag / _sag(place), 1.0, within, why),
                Check(
                    f"first frequency over theory, {number} cells across",
                    0.5 / turned / frequency,
                    1.0,
                    within,
                    "as above",
                ),
            ]
    moments = np.linspace(0.0, PERIODS / frequency, 100)
    series["theory_times"] = moments
    series["theory_ways"] = -1e3 * _sag(LENGTH) * (1.0 - np.cos(2.0 * math.pi * frequency * moments))
    return checks, series


def _swing(cells: int, duration: float) -> tuple[Any, Any, float]:
    """Times [s], ways of the last particles along z [m], and where along the bar these are [m]."""
    side = 0.3
    wall = {"name": "wall", "kind": "static", "shape": {"type": "box", "size": (0.2, 0.4, 0.4)}}
    bar = {
        "name": "bar",
        "material": "jelly",
        **{"young_modulus": YOUNG, "poisson_ratio": POISSON, "density": DENSITY},
        "cell_size": THICKNESS / cells,
        "sticks_to": ("wall",),
        "block": (
            {
                "shape": {"type": "box", "size": (LENGTH, THICKNESS, THICKNESS)},
                "position": (0.5 * LENGTH, 0.0, 0.0),
            },
        ),
    }
    world = build_world(
        SceneParameters(
            gravity=(0.0, 0.0, -GRAVITY),
            domain={"min": (-side, -side, -side), "max": (LENGTH + 0.2, side, side), "open_faces": ()},
            rigid=({**wall, "position": (-0.1, 0.0, 0.0)},),
            soft=(bar,),
        ),
        frames_per_second=60,
    )
    solver: Any = world.solvers["soft"]
    along, _, up = solver.view("bar")["position"].copy().T
    last = along > along.max() - 1e-6
    times, ways = [], []
    for time in advance(solver, duration, cuts=CUTS):
        times.append(time)
        ways.append(float((solver.view("bar")["position"][last, 2] - up[last]).mean()))
    return np.array(times), np.array(ways), float(along[last].mean())


def _sag(place: float) -> float:
    """Of a beam under its own weight, bending and shear (Timoshenko 1921) [m]."""
    load, x = DENSITY * AREA * GRAVITY, place
    bending = load * x**2 * (6.0 * LENGTH**2 - 4.0 * LENGTH * x + x**2) / (24.0 * BENDING)
    return bending + load * (LENGTH * x - 0.5 * x**2) / SHEARING


def _frequency() -> float:
    """Lowest of Timoshenko's beam, clamped at one end [Hz]: linear elements, shear at their middles (Hughes 1977)."""
    count, step = 2 * (ELEMENTS + 1), LENGTH / ELEMENTS
    stiffness, mass = np.zeros((count, count)), np.zeros((count, count))
    turn, shear = np.array([0.0, -1.0, 0.0, 1.0]) / step, np.array([-1.0 / step, -0.5, 1.0 / step, -0.5])
    own = BENDING * np.outer(turn, turn) + SHEARING * np.outer(shear, shear)
    inertia = np.kron(np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0, DENSITY * np.diag([AREA, INERTIA]))
    for element in range(ELEMENTS):
        rows = slice(2 * element, 2 * element + 4)
        stiffness[rows, rows] += step * own
        mass[rows, rows] += step * inertia
    lowest = eigh(stiffness[2:, 2:], mass[2:, 2:], eigvals_only=True, subset_by_index=(0, 0))[0]
    return math.sqrt(lowest) / (2.0 * math.pi)


def draw(results: Sequence[CaseResult]) -> Figure:
    """The end of the bar over time."""
    figure, (axes,) = make_panels(1, width=4.2)
    series = results[0].series
    for number, shade in zip(series["cells"], FINER, strict=False):
        times, ways = series[f"times_{number}"], series[f"ways_{number}"]
        axes.plot(times, ways, color=shade, label=f"{number} cells across")
    axes.plot(
        series["theory_times"], series["theory_ways"], "--", color=THEORY, linewidth=1.0, label="first mode alone"
    )
    label_axes(axes, "time [s]", "way of the end [mm]", "a clamped bar, let go")
    return figure


CASE = Case(find, draw, solvers=("soft",), sizes={"cells": ((4, 6, 8), (4,))})
