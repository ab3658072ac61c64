"""A weightless circular drop in pure strain becomes an ellipse (Monaghan 1994, section 5.1).

Plane flow: v = A (-x, y), with p = 0 on the free surface, keeps an ellipse an ellipse. Its semi-axes a, b obey
da/dt = -A a, db/dt = A b, dA/dt = A² (a² - b²)/(a² + b²), and a b = R² as well as the kinetic energy stay as they are.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import COLOURS, THEORY, draw_refinement, label_axes, make_panels, refinement_of, style_of
from validation.scenes import WEIGHTLESS, advance, lattice, make_fluid, state_of, turn_about_y

RADIUS, STRAIN_RATE, DURATION = 1.0, 100.0, 0.0076  # R [m], A0 [1/s] and the time of the comparison [s]

TILT_DEG = 22.5
"""Of the particles' lattice against the axes of strain. One that is aligned with them is pulled apart into rows, two
spacings from each other when the drop is twice as long: out of reach of the kernel, so that the area grows."""

LAYERS_ACROSS = 6  # thickness of the slab in particles; smooth walls on both sides keep the flow plane
ARTIFICIAL_VISCOSITY = 0.01  # far below the default: the exact solution has none


@cache
def exact_axes(time: float) -> tuple[float, float, float]:
    """Semi-axes a, b [m] and strain rate A [1/s] at a time [s], integrated to 1e-10."""
    from scipy.integrate import solve_ivp

    def rates(_: float, state: np.ndarray) -> list[float]:
        a, b, strain = state
        return [-strain * a, strain * b, strain**2 * (a**2 - b**2) / (a**2 + b**2)]

    solution = solve_ivp(rates, (0.0, time), [RADIUS, RADIUS, STRAIN_RATE], rtol=1e-10, atol=1e-12)
    a, b, strain = solution.y[:, -1]
    return float(a), float(b), float(strain)


def stretch(solver: str, resolution: int) -> dict[str, Any]:
    """Semi-axes and energy of a drop of so many particles to the radius, over time."""
    spacing = RADIUS / resolution
    depth = LAYERS_ACROSS * spacing
    domain = DomainParameters(min=(-1.5, 0.0, -2.5), max=(1.5, depth, 2.5), open_faces=("x-", "x+", "z-", "z+"))
    side = 1.5 * RADIUS
    drop = lattice((-side, 0.0, -side), (side, depth, side), spacing) @ turn_about_y(TILT_DEG).astype(np.float32)
    drop = drop[np.hypot(drop[:, 0], drop[:, 2]) < RADIUS]
    velocity = STRAIN_RATE * drop * np.float32([-1.0, 0.0, 1.0])
    material = {"artificial_viscosity": ARTIFICIAL_VISCOSITY}
    fluid = make_fluid(solver, domain, drop, spacing=spacing, velocities=velocity, gravity=WEIGHTLESS, **material)
    start = fluid.diagnostics()
    times, axes, energies = [0.0], [_axes(drop)], [1.0]
    for time in advance(fluid, DURATION, cuts=38):
        position, _ = state_of(fluid)
        times.append(time)
        axes.append(_axes(position))
        energies.append(fluid.diagnostics()["kinetic_energy"] / start["kinetic_energy"])
    end = fluid.diagnostics()
    # Along y there are walls.
    momentum = np.array([end[f"momentum_{axis}"] - start[f"momentum_{axis}"] for axis in "xz"])
    scale = start["mass"] * STRAIN_RATE * RADIUS / 2.0
    # A lattice inside a circle is not quite a circle: the axes are compared over those of the start.
    across, along = (np.array(axes) / np.array(axes[0])).T.tolist()
    return {
        "times": times,
        "across": across,
        "along": along,
        "energies": energies,
        "momentum": float(np.abs(momentum).max()) / scale,
    }


def _axes(position: np.ndarray) -> tuple[float, float]:
    """Semi-axes of the ellipse of the same second moments, <x²> = a²/4 [m]."""
    across, along = 2.0 * np.std(position[:, [0, 2]].astype(np.float64), axis=0)
    return float(across), float(along)


def find(solver: str, resolutions: Sequence[int]) -> Found:
    """The drop at several resolutions, in particles to the radius."""
    runs = [stretch(solver, count) for count in resolutions]
    exact_across, exact_along, _ = exact_axes(DURATION)
    finest = runs[-1]
    errors = [abs(each["along"][-1] / exact_along - 1.0) for each in runs]
    checks = [
        Check("semi-axis along", finest["along"][-1], exact_along, 0.005 * exact_along,
              "the fluid is compressible by 1 %, which is half a percent of each axis", "m"),
        Check("semi-axis across", finest["across"][-1], exact_across, 0.015 * exact_across,
              "1 % of compressibility, and it is four times as few particles long", "m"),
        Check("product of the axes over R²", finest["across"][-1] * finest["along"][-1], 1.0, 0.015,
              "the area, to the compressibility"),
        Check("kinetic energy kept", finest["energies"][-1], 1.0, 0.01,
              "the artificial viscosity and the compression waves of the start may take 1 %"),
        Check("drift of momentum over m A0 R / 2", finest["momentum"], 0.0, 1e-4,
              "walls of samples are not quite smooth along the slab; without walls see the free drop"),
    ]  # fmt: skip
    series: dict[str, Any] = {"resolutions": list(resolutions), "errors": errors}
    for count, each in zip(resolutions, runs, strict=True):
        series |= {f"{name}_{count}": each[name] for name in ("times", "across", "along", "energies")}
    series["exact_across"] = [exact_axes(time)[0] for time in finest["times"][1:]]
    series["exact_along"] = [exact_axes(time)[1] for time in finest["times"][1:]]
    return checks, series


def draw(results: Sequence[CaseResult]) -> Figure:
    """Semi-axes and kinetic energy over time, refinement."""
    figure, (axes, energy, order) = make_panels(3)
    for result in results:
        series, finest = result.series, max(result.series["resolutions"])
        times = [1e3 * time for time in series[f"times_{finest}"]]
        axes.plot(times, series[f"along_{finest}"], **style_of(result))
        axes.plot(times, series[f"across_{finest}"], color=COLOURS[result.solver])
        energy.plot(times, series[f"energies_{finest}"], **style_of(result))
    for name, label in (("exact_along", "exact"), ("exact_across", None)):
        axes.plot(times[1:], results[0].series[name], ":", color=THEORY, label=label)
    label_axes(axes, "time [ms]", "semi-axis [m]", "semi-axes")
    energy.axhline(1.0, color=THEORY, linewidth=1.0)
    energy.set_ylim(0.985, 1.001)
    label_axes(energy, "time [ms]", "kinetic energy / that of the start", "energy", legend="lower left")
    draw_refinement(order, refinement_of(results, "resolutions"), 1, "spacing / R", "error of the long axis")
    return figure


CASE = Case(find, draw, sizes={"resolutions": ((10, 20, 40), (10, 20))})
