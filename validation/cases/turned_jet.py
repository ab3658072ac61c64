"""A jet along a floor that a wall turns upwards: free-streamline theory gives its thickness, speed and pressure.

Without gravity the speed on a free streamline is constant, so that the jet leaves as thick and as fast as it came. With
v the speed on the wall over that of the jet, a its thickness and z the height (Milne-Thomson, Theoretical
Hydrodynamics, 11.42; hodograph of a source and a sink on a quarter of a circle):

    z / a = 4/pi (arctan v + artanh v),    p = rho U²/2 (1 - v²),    force on the wall = rho U² a for each metre across
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import FINER, THEORY, label_axes, make_panels, style_of
from validation.scenes import WATER, WEIGHTLESS, advance, lattice, make_fluid, state_of, wall_forces

THICKNESS, SPEED = 0.08, 2.0  # a [m] and U [m/s]
LAYERS_ACROSS = 6  # thickness of the slab in particles; smooth walls on both sides keep the flow plane
AWAY = 2.5  # distance of its tip from the wall at the start [a]
STEADY, END = (11.5, 15.0)  # from when to when the flow is looked at [a/U]
LEAVING = (3.0, 5.0)  # heights between which the sheet that leaves is looked at [a]
CLEARANCE, CLEARANCE_ACROSS = 0.1, 0.02
"""Of the lattice from floor and sides, in spacings: beside walls a lattice is compressed by 0.5 to 0.9 %. Without
gravity nothing holds together again what that drives apart, at 6 % of U."""

BINS = np.linspace(0.0, 3.0, 13)  # heights between which the pressure on the wall is averaged [a]


def wall_speed(height: np.ndarray) -> np.ndarray:
    """Speed on the wall over U at heights over a."""
    v = np.linspace(0.0, 1.0 - 1e-9, 200_001)
    return np.interp(height, 4.0 / np.pi * (np.arctan(v) + np.arctanh(v)), v)


def turn(solver: str, layers: int) -> dict[str, Any]:
    """The jet, so many particles thick: what leaves, and the pressure on the wall."""
    a, spacing = THICKNESS, THICKNESS / layers
    length, depth = (AWAY + END + 1.0) * a, LAYERS_ACROSS * spacing
    gap = CLEARANCE_ACROSS * spacing
    domain = DomainParameters(min=(0.0, -gap, 0.0), max=(length, depth + gap, (END + 2.0) * a), open_faces=("x-", "z+"))
    jet = lattice((0.0, 0.0, 0.0), (length - AWAY * a, depth, a), spacing) + np.float32([0, 0, CLEARANCE * spacing])
    velocity = np.broadcast_to(np.float32([SPEED, 0.0, 0.0]), jet.shape)
    fluid = make_fluid(solver, domain, jet, spacing=spacing, velocities=velocity, gravity=WEIGHTLESS)
    pressures, thicknesses, speeds = [], [], []
    width = depth + 2.0 * gap
    for time in advance(fluid, END * a / SPEED, cuts=100):
        if time < STEADY * a / SPEED:
            continue
        samples, pushes = wall_forces(fluid)
        on_wall = samples[:, 0] > length + 0.5 * spacing  # its samples lie 0.95 spacings deep, others end 0.05 beyond
        # A sample bears what comes to the area around it: half of that lies beneath.
        heights = np.maximum(np.add.outer((-0.25 * spacing, 0.25 * spacing), samples[on_wall, 2]), 0.0) / a
        force = np.histogram(heights, BINS, weights=np.broadcast_to(0.5 * pushes[on_wall, 0], heights.shape))[0]
        pressures.append(force / (np.diff(BINS) * a * width) / (0.5 * WATER * SPEED**2))
        position, velocities = state_of(fluid)
        leaving = (position[:, 2] > LEAVING[0] * a) & (position[:, 2] < LEAVING[1] * a)
        thicknesses.append(leaving.sum() * spacing**3 / ((LEAVING[1] - LEAVING[0]) * a * depth) / a)
        speeds.append(velocities[leaving, 2].mean() / SPEED)
    pressure = np.mean(pressures, axis=0)
    return {
        "pressure": pressure.tolist(),
        "force": float((pressure * np.diff(BINS)).sum()) / 2.0,
        "thickness": float(np.mean(thicknesses)),
        "speed": float(np.mean(speeds)),
    }


def find(solver: str, layers: Sequence[int]) -> Found:
    """The jet at several resolutions, in layers of particles."""
    runs = [turn(solver, count) for count in layers]
    finest = runs[-1]
    middles = 0.5 * (BINS[1:] + BINS[:-1])
    error = np.array(finest["pressure"]) - (1.0 - wall_speed(middles) ** 2)
    expected = float(np.mean(1.0 - wall_speed(np.linspace(*BINS[[0, -1]], 20_001)) ** 2) * BINS[-1] / 2.0)
    lost = "what is lost where the jet is compressed at the foot, about one smoothing length wide"
    checks = [
        Check("speed of the sheet that leaves over that of the jet", finest["speed"], 1.0, 0.08, lost),
        Check("its thickness over that of the jet", finest["thickness"], 1.0, 0.08,
              "a third of a spacing at the coarsest"),
        Check("force on the wall over rho U² a", finest["force"], expected, 0.12,
              "the speed's error, and that of the momentum that has not arrived yet"),
        Check("rms error of the pressure on the wall over rho U²/2", float(np.sqrt((error**2).mean())), 0.0, 0.25,
              "still water fills the corner, most where artificial viscosity is largest"),
    ]  # fmt: skip
    return checks, {"layers": list(layers), "heights": middles.tolist()} | {
        f"pressure_{count}": each["pressure"] for count, each in zip(layers, runs, strict=True)
    } | {name: [each[name] for each in runs] for name in ("thickness", "speed", "force")}


def draw(results: Sequence[CaseResult]) -> Figure:
    """Pressure over height on the wall."""
    figure, (solvers, resolutions) = make_panels(2)
    heights = np.linspace(0.0, 3.0, 200)
    for axes in (solvers, resolutions):
        axes.plot(1.0 - wall_speed(heights) ** 2, heights, color=THEORY, linewidth=1.0, label="free streamlines")
    for result in results:
        finest = max(result.series["layers"])
        solvers.plot(
            result.series[f"pressure_{finest}"], result.series["heights"], "o", markersize=3, **style_of(result)
        )
    for count, shade in zip(results[0].series["layers"], FINER, strict=False):
        resolutions.plot(
            results[0].series[f"pressure_{count}"],
            results[0].series["heights"],
            color=shade,
            label=f"thickness / {count}",
        )
    for axes, title in ((solvers, "solvers"), (resolutions, "refinement")):
        label_axes(axes, "p / (rho U² / 2)", "height / thickness of the jet", title)
    return figure


CASE = Case(find, draw, sizes={"layers": ((4, 8, 16), (4,))})
