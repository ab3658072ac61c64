"""Draws the figures: small, light, one colour a solver, measurements and theory in black."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.validation.checks import CaseResult

COLOURS = {
    "wcsph": "#2a6fbb",
    "dfsph": "#d1652b",
    "pcisph": "#2f8f5b",
    "rigid": "#2a6fbb",
    "cloth": "#2a6fbb",
    "maccormack": "#2a6fbb",
    "semi_lagrangian": "#d1652b",
}
TITLES = {
    "wcsph": "WCSPH",
    "dfsph": "DFSPH",
    "pcisph": "PCISPH",
    "rigid": "rigid body",
    "cloth": "cloth",
    "maccormack": "MacCormack",
    "semi_lagrangian": "semi-Lagrangian",
}
MEAN_OF = 20
"""Samples of a running mean."""

THEORY = "#222222"
SHADES = ("#2a6fbb", "#d1652b", "#2f8f5b", "#8a5fb0")

mpl.rcParams.update(
    {
        "svg.fonttype": "none",
        "svg.hashsalt": "validation",
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 8.5,
        "axes.grid": True,
        "grid.color": "#e2e2e2",
        "grid.linewidth": 0.6,
        "axes.edgecolor": "#888888",
        "axes.linewidth": 0.7,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 9,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "lines.linewidth": 1.5,
    }
)


def _panels(count: int, *, width: float = 3.4, height: float = 2.7) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, [figure.add_subplot(1, count, number + 1) for number in range(count)]


def _label(axes: Axes, x: str, y: str, title: str = "", *, legend: bool | str = True) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left")
    if legend:
        axes.legend(loc="best" if legend is True else legend)


def _style(result: CaseResult) -> dict[str, Any]:
    return {"color": COLOURS[result.solver], "label": TITLES[result.solver]}


def _order_line(axes: Axes, spacings: Sequence[float], largest: float, order: int) -> None:
    """A dashed line of that slope beside the errors."""
    line = [largest * (spacing / max(spacings)) ** order for spacing in spacings]
    axes.plot(spacings, line, "--", color=THEORY, linewidth=1.0, label=f"order {order}")


def _refinement(axes: Axes, results: Sequence[CaseResult], counts: str, order: int, x: str, y: str) -> None:
    for result in results:
        spacings = [1.0 / count for count in result.series[counts]]
        axes.loglog(spacings, result.series["errors"], "o-", markersize=4, **_style(result))
    largest = max(max(result.series["errors"]) for result in results)
    _order_line(axes, spacings, largest, order)
    axes.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
    axes.set_xticks([], minor=True)
    _label(axes, x, y, "refinement")


def draw_kernel(results: Sequence[CaseResult]) -> Figure:
    """Shape of the kernel, and the order of smoothing."""
    figure, (shape, order) = _panels(2)
    series = results[0].series
    shape.plot(series["q"], series["w"], color=COLOURS["wcsph"])
    _label(shape, "|x| / h", "W pi h³ / 8", "cubic spline", legend=False)
    spacings = [1.0 / count for count in series["spacings"]]
    order.loglog(spacings, series["smoothing"], "o-", color=COLOURS["wcsph"], label="smoothed sine")
    _order_line(order, spacings, max(series["smoothing"]), 2)
    order.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
    order.set_xticks([], minor=True)
    _label(order, "spacing / wavelength", "relative error", "refinement")
    return figure


def draw_hydrostatic(results: Sequence[CaseResult]) -> Figure:
    """Pressure over depth, force on the floor over time, refinement."""
    figure, (profile, force, order) = _panels(3)
    for result in results:
        finest = max(result.series["layers"])
        style = _style(result)
        profile.plot(result.series[f"pressure_{finest}"], result.series[f"depth_{finest}"], "o", markersize=3, **style)
        means = np.convolve(result.series["forces"], np.full(MEAN_OF, 1.0 / MEAN_OF), mode="valid")
        force.plot(result.series["times"][MEAN_OF - 1 :], means, linewidth=1.0, **style)
    profile.plot([0.0, 1.0], [0.0, 1.0], color=THEORY, linewidth=1.0, label="rho g (H - z)")
    profile.invert_yaxis()
    _label(profile, "p / rho g H", "depth / H", "pressure, mean of 1 s")
    force.axhline(1.0, color=THEORY, linewidth=1.0)
    force.set_ylim(0.9, 1.1)
    _label(force, "time [s]", "force on the floor / weight", "force, mean of the last 0.2 s")
    _refinement(order, results, "layers", 1, "spacing / H", "rms error / rho g H")
    return figure


def draw_dam_break(results: Sequence[CaseResult]) -> Figure:
    """Fronts of all solvers and experiments, and of one solver at all resolutions."""
    from benchmarks.validation.dam_break import experiments

    figure, (solvers, resolutions) = _panels(2, width=4.2, height=3.2)
    marks = dict(zip(experiments(), "sov", strict=True))
    names = {
        "martin_moyce_2.25in": "Martin & Moyce, 2.25 in",
        "martin_moyce_1.125in": "Martin & Moyce, 1.125 in",
        "koshizuka_oka": "Koshizuka & Oka",
    }
    for axes in (solvers, resolutions):
        for name, (times, fronts) in experiments().items():
            axes.plot(times, fronts, marks[name], color=THEORY, markersize=4, fillstyle="none", label=names[name])
        axes.set_xlim(0.0, 4.0)
        axes.set_ylim(1.0, 6.5)
    for result in results:
        finest = max(result.series["columns"])
        solvers.plot(result.series[f"times_{finest}"], result.series[f"fronts_{finest}"], **_style(result))
    shown = results[0]
    for count, shade in zip(shown.series["columns"], ("#a9c8ea", "#5f9bd6", "#1d4f86"), strict=True):
        resolutions.plot(
            shown.series[f"times_{count}"], shown.series[f"fronts_{count}"], color=shade, label=f"width / {count}"
        )
    _label(solvers, "T = t (2 g / width)^(1/2)", "front / width", f"solvers, spacing width / {finest}")
    _label(resolutions, "T", "front / width", f"{TITLES[shown.solver]}, refinement")
    return figure


def draw_elliptical_drop(results: Sequence[CaseResult]) -> Figure:
    """Semi-axes and kinetic energy over time, refinement."""
    figure, (axes, energy, order) = _panels(3)
    for result in results:
        finest = max(result.series["resolutions"])
        times = [1e3 * time for time in result.series[f"times_{finest}"]]
        axes.plot(times, result.series[f"along_{finest}"], **_style(result))
        axes.plot(times, result.series[f"across_{finest}"], color=COLOURS[result.solver])
        energy.plot(times, result.series[f"energies_{finest}"], **_style(result))
    for name in ("exact_along", "exact_across"):
        label = "exact" if name == "exact_along" else None
        axes.plot(times[1:], results[0].series[name], ":", color=THEORY, label=label)
    _label(axes, "time [ms]", "semi-axis [m]", "semi-axes")
    energy.axhline(1.0, color=THEORY, linewidth=1.0)
    energy.set_ylim(0.985, 1.001)
    _label(energy, "time [ms]", "kinetic energy / that of the start", "energy", legend="lower left")
    _refinement(order, results, "resolutions", 1, "spacing / R", "error of the long axis")
    return figure


def draw_viscosity(results: Sequence[CaseResult]) -> Figure:
    """Decay of the wave along an axis and along a diagonal, refinement."""
    figure, (decay, order) = _panels(2)
    for result in results:
        for name, dash in (("axis", "-"), ("diagonal", "--")):
            decay.semilogy(
                result.series["times"], result.series[f"amplitudes_{name}"], dash, color=COLOURS[result.solver]
            )
        decay.plot([], [], **_style(result))
    times = results[0].series["times"]
    decay.semilogy(times, [2.718281828**-time for time in times], ":", color=THEORY, label="exp(-nu k² t)")
    decay.minorticks_off()
    decay.set_yticks([0.92, 0.94, 0.96, 0.98, 1.0], ["0.92", "0.94", "0.96", "0.98", "1"])
    _label(decay, "nu k² t", "amplitude", "axis (solid), diagonal (dashed)")
    _refinement(order, results, "resolutions", 2, "spacing / wavelength", "error of the rate")
    return figure


def draw_free_momentum(results: Sequence[CaseResult]) -> Figure:
    """Drift over time."""
    return _drifts(results, {"linear": "linear", "angular": "angular"})


def draw_coupled_momentum(results: Sequence[CaseResult]) -> Figure:
    """Drift over time, of the collision with the lightest box."""
    lightest = min(results[0].settings["densities"])
    return _drifts(results, {name: f"{name}_{lightest:g}" for name in ("linear", "angular")})


def _drifts(results: Sequence[CaseResult], curves: dict[str, str]) -> Figure:
    figure, panels = _panels(2)
    for axes, (name, curve) in zip(panels, curves.items(), strict=True):
        for result in results:
            # A drift of exactly zero has no place on a logarithmic axis.
            drifts = [max(drift, 1e-10) for drift in result.series[curve]]
            axes.semilogy(result.series["times"], drifts, **_style(result))
        axes.axhline(1e-5, color=THEORY, linewidth=1.0, linestyle="--", label="bound")
        axes.set_ylim(1e-10, 1e-2)
        _label(axes, "time [s]", "relative drift", f"{name} momentum", legend="upper left")
    return figure


def draw_rigid_motion(results: Sequence[CaseResult]) -> Figure:
    """Energy of a free rotation, the racket's flips, refinement."""
    figure, (energy, racket, order) = _panels(3)
    series = results[0].series
    energy.plot(series["times"], [1e6 * each for each in series["energies"]], color=COLOURS["rigid"], linewidth=0.8)
    _label(energy, "time [s]", "energy / that of the start - 1  [1e-6]", "rotation without torque", legend=False)
    racket.plot(series["racket_times"], series["racket_spin"], color=COLOURS["rigid"])
    _label(racket, "time [s]", "spin about the middle axis / start", "tennis racket", legend=False)
    order.loglog(series["steps"], series["errors"], "o-", color=COLOURS["rigid"], label="after 2 s")
    _order_line(order, series["steps"], max(series["errors"]), 2)
    order.set_xticks(series["steps"], [f"{1e3 * step:g}" for step in series["steps"]], minor=False)
    order.set_xticks([], minor=True)
    _label(order, "time step [ms]", "error of the spin [rad/s]", "refinement")
    return figure


def draw_rigid_contacts(results: Sequence[CaseResult]) -> Figure:
    """Bounces, the slope, the stack."""
    figure, (bounce, slope, stack) = _panels(3)
    series = results[0].series
    for restitution, shade in zip(series["restitutions"], SHADES, strict=False):
        bounce.plot(
            series[f"times_{restitution:g}"], series[f"path_{restitution:g}"], color=shade, label=f"e = {restitution:g}"
        )
        bounce.axhline(restitution**2, color=shade, linewidth=0.7, linestyle=":")
    _label(bounce, "time [s]", "height / h", "bounce; dotted: e²")
    slope.plot(series["slope_times"], series["slope_ways"], color=SHADES[0], label="mu = 0.2")
    slope.plot(series["slope_times"], series["stuck_ways"], color=SHADES[1], label="mu = 0.8")
    exact = [0.5 * 9.81 * (0.5 - 0.2 * 0.8660254) * time**2 for time in series["slope_times"]]
    slope.plot(series["slope_times"], exact, ":", color=THEORY, label="theory")
    _label(slope, "time [s]", "way down the slope [m]", "slope of 30°")
    stack.plot(series["stack_times"], [1e6 * way for way in series["stack_ways"]], color=SHADES[0])
    stack.set_ylim(bottom=0.0)
    _label(stack, "time [s]", "farthest way of a box [micrometres]", "stack of five", legend=False)
    return figure


def draw_submerged_sphere(results: Sequence[CaseResult]) -> Figure:
    """Force on held spheres and added mass by size, speed of released ones."""
    figure, (held, added, released) = _panels(3)
    for number, result in enumerate(results):
        series, style = result.series, {**_style(result), "markersize": 4, "linewidth": 1.0}
        sizes = [size + 0.06 * (number - 1) for size in series["sizes"]]
        held.errorbar(sizes, series["held"], series["held_error"], fmt="o-", **style)
        added.errorbar(sizes, series["added_mass"], series["added_mass_error"], fmt="o-", **style)
        times = [1e3 * time for time in series["times"]]
        for density, dash in zip(result.settings["densities"], ("-", "--"), strict=True):
            released.plot(times, series[f"released_{density:g}"], dash, color=COLOURS[result.solver])
    for axes in (held, added):
        axes.set_xticks(results[0].series["sizes"])
    held.axhline(1.0, color=THEORY, linewidth=1.0)
    held.set_ylim(0.9, 1.1)
    _label(held, "radius / spacing", "force / rho g V", "held sphere; bars: standard error")
    added.axhline(results[0].settings["added_mass"], color=THEORY, linewidth=1.0)
    added.set_ylim(0.4, 0.7)
    _label(added, "radius / spacing", "added / displaced mass", "sphere let go; black: theory")
    released.plot([0.0, times[-1]], [0.0, 1e-3 * times[-1]], color=THEORY, linewidth=1.0, label="theory at first")
    for density, dash in zip(results[0].settings["densities"], ("-", "--"), strict=True):
        released.plot([], [], dash, color="#777777", label=f"{density:g} kg/m³")
    _label(released, "time [ms]", "speed / first acceleration [s]", f"R = {series['sizes'][-1]} d")
    return figure


def draw_buoyancy(results: Sequence[CaseResult]) -> Figure:
    """Way of neutral bodies, draught of boxes."""
    figure, (neutral, afloat) = _panels(2, width=4.2)
    dashes = ("-", "--", ":")
    for result in results:
        series, colour = result.series, COLOURS[result.solver]
        for name, dash in (("sphere", "-"), ("duck", "--")):
            neutral.plot(series["neutral_times"], [1e3 * way for way in series[f"ways_{name}"]], dash, color=colour)
        neutral.plot([], [], **_style(result))
        for density, dash in zip(result.settings["floating_densities"], dashes, strict=False):
            draughts = [1e3 * draught for draught in series[f"afloat_{density:g}"]]
            afloat.plot(series["afloat_times"], draughts, dash, color=colour, linewidth=1.0)
    neutral.axhline(1e3 * results[0].settings["spacing_m"], color=THEORY, linewidth=1.0, label="one spacing")
    _label(neutral, "time [s]", "way [mm]", "neutral sphere (solid) and duck (dashed)")
    for density in results[0].settings["floating_densities"]:
        exact = 1e3 * density / 1000.0 * results[0].settings["box_m"][2]
        afloat.axhline(exact, color=THEORY, linewidth=1.0)
    densities = ", ".join(f"{density:g}" for density in results[0].settings["floating_densities"])
    _label(afloat, "time [s]", "draught [mm]; black: theory", f"floating box, {densities} kg/m³", legend=False)
    return figure


def draw_bunny_energy(results: Sequence[CaseResult]) -> Figure:
    """Mechanical and kinetic energy over time."""
    figure, (total, kinetic) = _panels(2, width=4.2, height=3.0)
    for result in results:
        times = result.series["times"]
        total.plot(times, result.series["kept"], **_style(result))
        if "kept_with_equal_viscosity" in result.series:
            alike = result.series["kept_with_equal_viscosity"]
            total.plot(times, alike, ":", color=COLOURS[result.solver], label="WCSPH, viscosity of the others")
        kinetic.plot(result.series["times"], result.series["kinetic"], **_style(result))
    for axes in (total, kinetic):
        axes.set_ylim(bottom=0.0)
    _label(total, "time [s]", "energy / that of the start", "mechanical energy")
    _label(kinetic, "time [s]", "kinetic energy / energy of the start", "kinetic energy")
    return figure


def draw_cloth(results: Sequence[CaseResult]) -> Figure:
    """Stretch of a column by rows, refinement of a band's sag, energy of a swinging sheet."""
    figure, (column, order, energy) = _panels(3)
    series = results[0].series
    for name, label, shade in (("xpbd", "XPBD, cotton", SHADES[0]), ("explicit", "explicit, 60 N/m", SHADES[1])):
        relative = [100.0 * (ratio - 1.0) for ratio in series[f"ratio_{name}"]]
        column.plot(series[f"rows_{name}"], relative, "o-", markersize=3, color=shade, label=label)
    column.axhspan(-1.0, 1.0, color="#eeeeee", zorder=0)
    column.set_ylim(-1.5, 1.5)
    _label(column, "row from above", "stretch / theory - 1  [%]", "hanging column; grey: 1 %")
    spacings = [1.0 / count for count in series["cells"]]
    order.loglog(spacings, series["errors"], "o-", markersize=4, color=SHADES[0], label="band between two bars")
    _order_line(order, spacings, max(series["errors"]), 2)
    order.set_xticks(spacings, [f"1/{count}" for count in series["cells"]], minor=False)
    order.set_xticks([], minor=True)
    _label(order, "spacing / span", "error of the sag [m]", "refinement")
    energy.plot(series["times"], [100.0 * each for each in series["energies"]], color=SHADES[0], linewidth=0.8)
    energy.set_ylim(-1.0, 1.0)
    _label(energy, "time [s]", "energy - start / (m g L/2)  [%]", "undamped sheet, explicit", legend=False)
    return figure


def draw_smoke_vortices(results: Sequence[CaseResult]) -> Figure:
    """Refinement of a turning blob and of vortices, energy of a lone vortex with confinement."""
    figure, (blob, vortices, energy) = _panels(3)
    for result in results:
        series, style = result.series, {**_style(result), "markersize": 4}
        plane = [1.0 / count for count in series["plane_cells"]]
        space = [1.0 / count for count in series["space_cells"]]
        blob.loglog(plane, series["rotation_errors"], "o-", **style)
        vortices.loglog(plane, series["plane_errors"], "o-", **style)
        vortices.loglog(space, series["space_errors"], "s--", markersize=4, color=COLOURS[result.solver])
    _order_line(blob, plane, max(results[0].series["rotation_errors"]), 2)
    _order_line(vortices, plane, max(results[0].series["plane_errors"]), 1)
    for axes, spacings in ((blob, plane), (vortices, sorted({*plane, *space}))):
        axes.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
        axes.set_xticks([], minor=True)
    _label(blob, "cell / box", "mean error / mean", "blob, one turn")
    _label(vortices, "cell / box", "rms error / rms", "vortices: plane (solid), in space (dashed)")
    shown = results[0]
    for strength, shade in zip((0.0, *shown.settings["strengths"]), SHADES, strict=False):
        energy.plot(
            shown.series["times"], shown.series[f"energy_{strength:g}"], color=shade, label=f"eps = {strength:g}"
        )
    _label(energy, "time [s]", "kinetic energy / at first", f"lone vortex, {TITLES[shown.solver]}")
    return figure


def draw_smoke_projection(results: Sequence[CaseResult]) -> Figure:
    """Divergence left by each iteration, and refinement against an exact projection."""
    figure, (left, order) = _panels(2, width=4.2)
    series, settings = results[0].series, results[0].settings
    finest = max(settings["rough_cells"])
    histories = [name for name in series if name.startswith("left, ") and name.endswith(f", {finest}")]
    for name, shade in zip(histories, SHADES, strict=False):
        left.semilogy(series[name], "o-", markersize=4, color=shade, label=name.split(", ")[1])
    left.axhline(settings["tolerance"], color=THEORY, linewidth=1.0, linestyle="--")
    _label(left, "iteration", "max|div u| h / max|u|", f"jet with noise, {finest}³ cells; dashed: goal")
    spacings = [1.0 / count for count in series["cells"]]
    for name, shade in (("walls", SHADES[0]), ("open sides", SHADES[1])):
        order.loglog(spacings, series[f"errors, {name}"], "o-", markersize=4, color=shade, label=name)
    _order_line(order, spacings, max(series["errors, open sides"]), 2)
    order.set_xticks(spacings, [f"1/{count}" for count in series["cells"]], minor=False)
    order.set_xticks([], minor=True)
    _label(order, "cell / box", "rms error / rms", "exact projection")
    return figure


def draw_smoke_plume(results: Sequence[CaseResult]) -> Figure:
    """Rise of a thermal at several resolutions, and smoke over what was emitted."""
    figure, (rise, kept) = _panels(2, width=4.2)
    series = results[0].series
    for count, shade in zip(series["cells"], SHADES, strict=False):
        rise.plot(series["thermal_times"], series[f"rises_{count}"], "o-", markersize=3, color=shade,
                  label=f"{count} cells a metre")  # fmt: skip
    _label(rise, "time [s]", "rise of its centre [m]", "thermal")
    kept.plot(series["times"], series["kept_closed"], color=SHADES[0], label="closed box")
    kept.plot(series["times"], series["kept_around"], color=SHADES[1], label="open box, past a ball")
    kept.axhspan(0.99, 1.01, color="#eeeeee", zorder=0)
    kept.set_ylim(0.97, 1.03)
    _label(kept, "time [s]", "smoke / emitted smoke", "balance; grey: 1 %")
    return figure


def draw_smoke_mass(results: Sequence[CaseResult]) -> Figure:
    """Smoke left in an even wind, balance of a plume that leaves, smoke around a moving ball."""
    figure, (blown, leaving, stirred) = _panels(3)
    series = results[0].series
    counts = results[0].settings["blob_cells"]
    for count, shade in zip(counts, SHADES, strict=False):
        blown.plot(series[f"blown_times_{count}"], series[f"blown_kept_{count}"], color=shade, label=f"{count} cells")
    blown.plot(series[f"blown_times_{counts[-1]}"], series[f"blown_exact_{counts[-1]}"], ":", color=THEORY,
               label="exact")  # fmt: skip
    _label(blown, "time [s]", "smoke / at first", "blob in even wind")
    leaving.plot(series["leaving_times"], series["leaving_kept"], color=SHADES[0], label="in the box")
    leaving.plot(series["leaving_times"], series["leaving_balance"], color=SHADES[1], label="and what left")
    leaving.set_ylim(bottom=0.0)
    _label(leaving, "time [s]", "smoke / emitted smoke", "plume, open box")
    stirred.plot(series["stirred_times"], series["stirred_kept"], color=SHADES[0], label="in the box")
    for name, shade in (("covered", SHADES[1]), ("uncovered", SHADES[2])):
        stirred.plot(series["stirred_times"], series[f"stirred_{name}"], color=shade, label=name)
    stirred.set_ylim(bottom=0.0)
    _label(stirred, "time [s]", "smoke / emitted smoke", "moving ball, closed box")
    return figure


DRAWINGS: dict[str, Callable[[Sequence[CaseResult]], Figure]] = {
    "kernel": draw_kernel,
    "hydrostatic": draw_hydrostatic,
    "dam-break": draw_dam_break,
    "elliptical-drop": draw_elliptical_drop,
    "viscosity": draw_viscosity,
    "free-momentum": draw_free_momentum,
    "coupled-momentum": draw_coupled_momentum,
    "submerged-sphere": draw_submerged_sphere,
    "buoyancy": draw_buoyancy,
    "bunny-energy": draw_bunny_energy,
    "rigid-motion": draw_rigid_motion,
    "rigid-contacts": draw_rigid_contacts,
    "cloth": draw_cloth,
    "smoke-vortices": draw_smoke_vortices,
    "smoke-projection": draw_smoke_projection,
    "smoke-plume": draw_smoke_plume,
    "smoke-mass": draw_smoke_mass,
}
