"""A weightless drop of 4 mm that swings about its ball (Rayleigh 1879), at the pressure of its surface (Laplace).

A drop of radius R that is drawn long and short has the frequency omega = sqrt(8 sigma/(rho R³)) while the swing is
small, and the pressure 2 sigma/R. It starts as a lattice, settles, and is set swinging by the velocity field of that
mode, a pure strain.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import curve_fit

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import FINER, THEORY, label_axes, make_panels, style_of
from validation.scenes import EVERY_FACE, WATER, WEIGHTLESS, advance, lattice, make_fluid, state_of

RADIUS, SURFACE_TENSION = 0.002, 0.072  # R [m] and sigma of water [N/m]
SETTLING, SWINGING = 1.5, 3.0  # periods before it swings, and of the swing
STRAIN = 0.05  # rate with which it is drawn out, over omega
CUTS = 40  # looks a period
WITHIN = 0.6  # radius in which its pressure is looked at [R]
SPACE = DomainParameters(min=(-4.0 * RADIUS,) * 3, max=(4.0 * RADIUS,) * 3, open_faces=EVERY_FACE)


def swing(solver: str, layers: int) -> dict[str, Any]:
    """The drop of so many particles to the radius: its frequency and damping, its pressure, and its elongation."""
    spacing = RADIUS / layers
    ball = lattice((-RADIUS,) * 3, (RADIUS,) * 3, spacing)
    ball = ball[np.linalg.norm(ball, axis=1) < RADIUS]
    material = {"surface_tension_model": "csf", "surface_tension": SURFACE_TENSION}
    fluid = make_fluid(solver, SPACE, ball, spacing=spacing, gravity=WEIGHTLESS, **material)
    radius = (3.0 * len(ball) * fluid.particle_volume / (4.0 * math.pi)) ** (1.0 / 3.0)
    rate = math.sqrt(8.0 * SURFACE_TENSION / (WATER * radius**3))
    period = 2.0 * math.pi / rate
    for _ in advance(fluid, SETTLING * period):
        pass
    at_rest = fluid.diagnostics()
    away = fluid.view("water")["position"]
    away = away - away.mean(axis=0)
    fluid.push("water", STRAIN * rate * away * np.float32((-0.5, -0.5, 1.0)))
    times, elongations, pressures = [], [], []
    for time in advance(fluid, SWINGING * period, cuts=round(SWINGING * CUTS)):
        position, _ = state_of(fluid)
        away = position - position.mean(axis=0)
        spread = (away**2).mean(axis=0)
        times.append(time / period)
        elongations.append(float((spread[2] - 0.5 * (spread[0] + spread[1])) / spread.mean()))
        inside = np.linalg.norm(away, axis=1) < WITHIN * radius
        pressures.append(float(fluid.snapshots()["water"].arrays["pressure"][inside].mean()))

    def damped(t: np.ndarray, *coefficients: float) -> np.ndarray:
        size, turns, decay, phase, offset = coefficients
        return size * np.exp(-decay * t) * np.sin(2.0 * np.pi * turns * t + phase) + offset

    (_, turns, decay, _, _), _ = curve_fit(damped, times, elongations, p0=(max(elongations), 1.0, 0.3, 0.0, 0.0))
    return {
        "frequency": float(turns),
        "damping": float(decay) / (2.0 * math.pi),
        "pressure": float(np.mean(pressures)) * radius / (2.0 * SURFACE_TENSION),
        "speed": math.sqrt(2.0 * at_rest["kinetic_energy"] / at_rest["mass"] * WATER * radius / SURFACE_TENSION),
        "times": times,
        "elongations": elongations,
    }


def find(solver: str, layers: Sequence[int]) -> Found:
    """The drop at several resolutions, in particles to the radius."""
    runs = [swing(solver, count) for count in layers]
    finest = runs[-1]
    checks = [
        Check("frequency over Rayleigh's", finest["frequency"], 1.0, 0.05, "of the radius, half a spacing is 5 to 8 %"),
        Check("damping over the frequency", finest["damping"], 0.0, 0.1,
              "0.12 sqrt(d/R), 0.04 to 0.05, by the viscosity that goes with tension, and by the artificial one"),
        Check("pressure over 2 sigma/R", finest["pressure"], 1.0, 0.07, "the gain is that of 7 or 8 particles"),
        Check("speed at rest over sqrt(sigma/(rho R))", finest["speed"], 0.0, 0.1,
              "curvatures of single particles are 1 % off, and stir"),
    ]  # fmt: skip
    return checks, {"layers": list(layers)} | {
        name: [each[name] for each in runs] for name in ("frequency", "damping", "pressure", "speed")
    } | {f"{name}_{count}": each[name] for count, each in zip(layers, runs, strict=True)
         for name in ("times", "elongations")}  # fmt: skip


def draw(results: Sequence[CaseResult]) -> Figure:
    """Elongation over time, by solver and by resolution."""
    figure, (solvers, resolutions) = make_panels(2)
    for result in results:
        finest = max(result.series["layers"])
        curve = result.series[f"elongations_{finest}"]
        solvers.plot(result.series[f"times_{finest}"], curve, "o", markersize=2, **style_of(result))
    for count, shade in zip(results[0].series["layers"], FINER, strict=False):
        curve = results[0].series[f"elongations_{count}"]
        resolutions.plot(results[0].series[f"times_{count}"], curve, color=shade, label=f"radius / {count}")
    for axes, title in ((solvers, "solvers"), (resolutions, "refinement")):
        for turn in np.arange(0.25, SWINGING, 0.5):  # extremes of a swing at Rayleigh's frequency
            axes.axvline(turn, ymax=0.75, color=THEORY, linewidth=0.5)
        axes.set_ylim(-0.15, 0.25)  # with room for the legend
        label_axes(axes, "time / Rayleigh's period", "elongation", title)
    return figure


CASE = Case(find, draw, sizes={"layers": ((6, 8, 10), (7,))})
