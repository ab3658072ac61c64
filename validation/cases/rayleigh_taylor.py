"""A wave of water over oil: it grows at the rate of Rayleigh and Taylor.

Between walls at the distance h above and below, without viscosity (Taylor 1950), from rest:

    a = a0 cosh(sigma t),    sigma² = A g k tanh(k h),    A = (rho_water - rho_oil)/(rho_water + rho_oil)
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import THEORY, label_axes, make_panels, style_of
from validation.scenes import EARTH, WATER, advance, lattice, make_fluid

OIL = 700.0  # its density [kg/m³]
LENGTH, DEPTH = 0.32, 0.08  # of the wave, and of each fluid [m]
LAYERS_ACROSS = 6  # thickness of the slab in particles; smooth walls on both sides keep the flow plane
START = 0.008  # amplitude at the start [m]
STEEPEST = 0.6  # slope of the interface up to which theory is linear [-]
INTERVAL, END = 0.01, 0.6  # between two looks at it, and when it must have got there [s]
WAVE_NUMBER = 2.0 * np.pi / LENGTH  # k [1/m]
RATE = float(np.sqrt((WATER - OIL) / (WATER + OIL) * -EARTH[2] * WAVE_NUMBER * np.tanh(WAVE_NUMBER * DEPTH)))  # [1/s]


def grow(solver: str, particles: int) -> dict[str, Any]:
    """Amplitudes over time [m], for so many particles a wave, and the rate of the nearest cosh over theory's [-]."""
    spacing = LENGTH / particles
    width = LAYERS_ACROSS * spacing
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(LENGTH, width, 2.8 * DEPTH))
    points = lattice((0.0, 0.0, 0.0), (LENGTH, width, 2.0 * DEPTH), spacing)
    interface = DEPTH + START * np.cos(WAVE_NUMBER * points[:, 0])
    fluid = make_fluid(
        solver,
        domain,
        points,
        spacing=spacing,
        coupled={"phase": (points[:, 2] > interface).astype(np.int32)},
        fluids=({"name": "oil", "rest_density": OIL}, {"name": "water"}),
        wall_friction=0.0,
        artificial_viscosity=0.0,
    )

    def amplitude() -> float:
        """First cosine of the height of the interface: the oil fills what is below."""
        x = fluid.snapshots()["oil"].arrays["position"][:, 0].astype(np.float64)
        return 2.0 * fluid.particle_volume * float(np.cos(WAVE_NUMBER * x).sum()) / (LENGTH * width)

    times, amplitudes = [0.0], [amplitude()]
    for time in advance(fluid, END, cuts=round(END / INTERVAL)):
        times.append(time)
        amplitudes.append(amplitude())
        if WAVE_NUMBER * amplitudes[-1] >= STEEPEST:
            break
    growth = np.array(amplitudes) / amplitudes[0]
    rate = float(least_squares(lambda sigma: growth - np.cosh(sigma * np.array(times)), [RATE]).x[0])
    return {"times": times, "amplitudes": amplitudes, "rate": rate / RATE}


def find(solver: str, particles: Sequence[int]) -> Found:
    """The wave at several resolutions, in particles along it."""
    runs = [grow(solver, count) for count in particles]
    finest = runs[-1]
    slope = WAVE_NUMBER * finest["amplitudes"][-1]
    layer = "the fluids slide along each other over a layer of two or three particles"
    checks = [
        Check("growth of the wave over the rate of theory", finest["rate"], 1.0, 0.15, layer),
        Check("slope of the interface at the end", slope, STEEPEST, 0.1, "the step of a look beyond it"),
    ]
    series = {"particles": list(particles), "rates": [each["rate"] for each in runs]}
    return checks, series | {name: finest[name] for name in ("times", "amplitudes")}


def draw(results: Sequence[CaseResult]) -> Figure:
    """Amplitude over time, and the rate over the number of particles along the wave."""
    figure, (growth, refinement) = make_panels(2)
    last = max(result.series["times"][-1] for result in results)
    times = np.linspace(0.0, last, 200)
    start = results[0].series["amplitudes"][0]
    growth.semilogy(times, 1000.0 * start * np.cosh(RATE * times), color=THEORY, linewidth=1.0, label="theory")
    refinement.axhline(1.0, color=THEORY, linewidth=1.0)
    for result in results:
        series, style = result.series, style_of(result)
        growth.plot(series["times"], 1000.0 * np.array(series["amplitudes"]), "o", markersize=3, **style)
        refinement.plot(series["particles"], series["rates"], "o-", markersize=4, **style)
    label_axes(growth, "t [s]", "amplitude [mm]", "finest")
    label_axes(refinement, "particles along the wave", "growth / theory", "refinement")
    return figure


CASE = Case(find, draw, sizes={"particles": ((32, 64, 96), (64,))})
