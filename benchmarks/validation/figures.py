"""Draws the figures: small, light, one colour a solver, measurements and theory in black."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

from benchmarks.validation import figures_smoke
from benchmarks.validation.checks import CaseResult
from benchmarks.validation.figure_style import (
    COLOURS,
    SHADES,
    THEORY,
    TITLES,
    draw_order,
    draw_refinement,
    label_axes,
    make_panels,
    style_of,
)

MEAN_OF = 20
"""Samples of a running mean."""


def draw_kernel(results: Sequence[CaseResult]) -> Figure:
    """Shape of the kernel, and the order of smoothing."""
    figure, (shape, order) = make_panels(2)
    series = results[0].series
    shape.plot(series["q"], series["w"], color=COLOURS["wcsph"])
    label_axes(shape, "|x| / h", "W pi h³ / 8", "cubic spline", legend=False)
    spacings = [1.0 / count for count in series["spacings"]]
    order.loglog(spacings, series["smoothing"], "o-", color=COLOURS["wcsph"], label="smoothed sine")
    draw_order(order, spacings, max(series["smoothing"]), 2)
    order.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
    order.set_xticks([], minor=True)
    label_axes(order, "spacing / wavelength", "relative error", "refinement")
    return figure


def draw_hydrostatic(results: Sequence[CaseResult]) -> Figure:
    """Pressure over depth, force on the floor over time, refinement."""
    figure, (profile, force, order) = make_panels(3)
    for result in results:
        finest = max(result.series["layers"])
        style = style_of(result)
        profile.plot(result.series[f"pressure_{finest}"], result.series[f"depth_{finest}"], "o", markersize=3, **style)
        means = np.convolve(result.series["forces"], np.full(MEAN_OF, 1.0 / MEAN_OF), mode="valid")
        force.plot(result.series["times"][MEAN_OF - 1 :], means, linewidth=1.0, **style)
    profile.plot([0.0, 1.0], [0.0, 1.0], color=THEORY, linewidth=1.0, label="rho g (H - z)")
    profile.invert_yaxis()
    label_axes(profile, "p / rho g H", "depth / H", "pressure, mean of 1 s")
    force.axhline(1.0, color=THEORY, linewidth=1.0)
    force.set_ylim(0.9, 1.1)
    label_axes(force, "time [s]", "force on the floor / weight", "force, mean of the last 0.2 s")
    draw_refinement(order, results, "layers", 1, "spacing / H", "rms error / rho g H")
    return figure


def draw_dam_break(results: Sequence[CaseResult]) -> Figure:
    """Fronts of all solvers and experiments, and of one solver at all resolutions."""
    from benchmarks.validation.dam_break import experiments

    figure, (solvers, resolutions) = make_panels(2, width=4.2, height=3.2)
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
        solvers.plot(result.series[f"times_{finest}"], result.series[f"fronts_{finest}"], **style_of(result))
    shown = results[0]
    for count, shade in zip(shown.series["columns"], ("#a9c8ea", "#5f9bd6", "#1d4f86"), strict=True):
        resolutions.plot(
            shown.series[f"times_{count}"], shown.series[f"fronts_{count}"], color=shade, label=f"width / {count}"
        )
    label_axes(solvers, "T = t (2 g / width)^(1/2)", "front / width", f"solvers, spacing width / {finest}")
    label_axes(resolutions, "T", "front / width", f"{TITLES[shown.solver]}, refinement")
    return figure


def draw_elliptical_drop(results: Sequence[CaseResult]) -> Figure:
    """Semi-axes and kinetic energy over time, refinement."""
    figure, (axes, energy, order) = make_panels(3)
    for result in results:
        finest = max(result.series["resolutions"])
        times = [1e3 * time for time in result.series[f"times_{finest}"]]
        axes.plot(times, result.series[f"along_{finest}"], **style_of(result))
        axes.plot(times, result.series[f"across_{finest}"], color=COLOURS[result.solver])
        energy.plot(times, result.series[f"energies_{finest}"], **style_of(result))
    for name in ("exact_along", "exact_across"):
        label = "exact" if name == "exact_along" else None
        axes.plot(times[1:], results[0].series[name], ":", color=THEORY, label=label)
    label_axes(axes, "time [ms]", "semi-axis [m]", "semi-axes")
    energy.axhline(1.0, color=THEORY, linewidth=1.0)
    energy.set_ylim(0.985, 1.001)
    label_axes(energy, "time [ms]", "kinetic energy / that of the start", "energy", legend="lower left")
    draw_refinement(order, results, "resolutions", 1, "spacing / R", "error of the long axis")
    return figure


def draw_viscosity(results: Sequence[CaseResult]) -> Figure:
    """Decay of the wave along an axis and along a diagonal, refinement."""
    figure, (decay, order) = make_panels(2)
    for result in results:
        for name, dash in (("axis", "-"), ("diagonal", "--")):
            decay.semilogy(
                result.series["times"], result.series[f"amplitudes_{name}"], dash, color=COLOURS[result.solver]
            )
        decay.plot([], [], **style_of(result))
    times = results[0].series["times"]
    decay.semilogy(times, [2.718281828**-time for time in times], ":", color=THEORY, label="exp(-nu k² t)")
    decay.minorticks_off()
    decay.set_yticks([0.92, 0.94, 0.96, 0.98, 1.0], ["0.92", "0.94", "0.96", "0.98", "1"])
    label_axes(decay, "nu k² t", "amplitude", "axis (solid), diagonal (dashed)")
    draw_refinement(order, results, "resolutions", 2, "spacing / wavelength", "error of the rate")
    return figure


def draw_free_momentum(results: Sequence[CaseResult]) -> Figure:
    """Drift over time."""
    return _drifts(results, {"linear": "linear", "angular": "angular"})


def draw_coupled_momentum(results: Sequence[CaseResult]) -> Figure:
    """Drift over time, of the collision with the lightest box."""
    lightest = min(results[0].settings["densities"])
    return _drifts(results, {name: f"{name}_{lightest:g}" for name in ("linear", "angular")})


def _drifts(results: Sequence[CaseResult], curves: dict[str, str]) -> Figure:
    figure, panels = make_panels(2)
    for axes, (name, curve) in zip(panels, curves.items(), strict=True):
        for result in results:
            # A drift of exactly zero has no place on a logarithmic axis.
            drifts = [max(drift, 1e-10) for drift in result.series[curve]]
            axes.semilogy(result.series["times"], drifts, **style_of(result))
        axes.axhline(1e-5, color=THEORY, linewidth=1.0, linestyle="--", label="bound")
        axes.set_ylim(1e-10, 1e-2)
        label_axes(axes, "time [s]", "relative drift", f"{name} momentum", legend="upper left")
    return figure


def draw_rigid_motion(results: Sequence[CaseResult]) -> Figure:
    """Energy of a free rotation, the racket's flips, refinement."""
    figure, (energy, racket, order) = make_panels(3)
    series = results[0].series
    energy.plot(series["times"], [1e6 * each for each in series["energies"]], color=COLOURS["rigid"], linewidth=0.8)
    label_axes(energy, "time [s]", "energy / that of the start - 1  [1e-6]", "rotation without torque", legend=False)
    racket.plot(series["racket_times"], series["racket_spin"], color=COLOURS["rigid"])
    label_axes(racket, "time [s]", "spin about the middle axis / start", "tennis racket", legend=False)
    order.loglog(series["steps"], series["errors"], "o-", color=COLOURS["rigid"], label="after 2 s")
    draw_order(order, series["steps"], max(series["errors"]), 2)
    order.set_xticks(series["steps"], [f"{1e3 * step:g}" for step in series["steps"]], minor=False)
    order.set_xticks([], minor=True)
    label_axes(order, "time step [ms]", "error of the spin [rad/s]", "refinement")
    return figure


def draw_rigid_contacts(results: Sequence[CaseResult]) -> Figure:
    """Bounces, the slope, the stack."""
    figure, (bounce, slope, stack) = make_panels(3)
    series = results[0].series
    for restitution, shade in zip(series["restitutions"], SHADES, strict=False):
        bounce.plot(
            series[f"times_{restitution:g}"], series[f"path_{restitution:g}"], color=shade, label=f"e = {restitution:g}"
        )
        bounce.axhline(restitution**2, color=shade, linewidth=0.7, linestyle=":")
    label_axes(bounce, "time [s]", "height / h", "bounce; dotted: e²")
    slope.plot(series["slope_times"], series["slope_ways"], color=SHADES[0], label="mu = 0.2")
    slope.plot(series["slope_times"], series["stuck_ways"], color=SHADES[1], label="mu = 0.8")
    exact = [0.5 * 9.81 * (0.5 - 0.2 * 0.8660254) * time**2 for time in series["slope_times"]]
    slope.plot(series["slope_times"], exact, ":", color=THEORY, label="theory")
    label_axes(slope, "time [s]", "way down the slope [m]", "slope of 30°")
    stack.plot(series["stack_times"], [1e6 * way for way in series["stack_ways"]], color=SHADES[0])
    stack.set_ylim(bottom=0.0)
    label_axes(stack, "time [s]", "farthest way of a box [micrometres]", "stack of five", legend=False)
    return figure


def draw_submerged_sphere(results: Sequence[CaseResult]) -> Figure:
    """Force on held spheres and added mass by size, speed of released ones."""
    figure, (held, added, released) = make_panels(3)
    for number, result in enumerate(results):
        series, style = result.series, {**style_of(result), "markersize": 4, "linewidth": 1.0}
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
    label_axes(held, "radius / spacing", "force / rho g V", "held sphere; bars: standard error")
    added.axhline(results[0].settings["added_mass"], color=THEORY, linewidth=1.0)
    added.set_ylim(0.4, 0.7)
    label_axes(added, "radius / spacing", "added / displaced mass", "sphere let go; black: theory")
    released.plot([0.0, times[-1]], [0.0, 1e-3 * times[-1]], color=THEORY, linewidth=1.0, label="theory at first")
    for density, dash in zip(results[0].settings["densities"], ("-", "--"), strict=True):
        released.plot([], [], dash, color="#777777", label=f"{density:g} kg/m³")
    label_axes(released, "time [ms]", "speed / first acceleration [s]", f"R = {series['sizes'][-1]} d")
    return figure


def draw_buoyancy(results: Sequence[CaseResult]) -> Figure:
    """Way of neutral bodies, draught of boxes."""
    figure, (neutral, afloat) = make_panels(2, width=4.2)
    dashes = ("-", "--", ":")
    for result in results:
        series, colour = result.series, COLOURS[result.solver]
        for name, dash in (("sphere", "-"), ("duck", "--")):
            neutral.plot(series["neutral_times"], [1e3 * way for way in series[f"ways_{name}"]], dash, color=colour)
        neutral.plot([], [], **style_of(result))
        for density, dash in zip(result.settings["floating_densities"], dashes, strict=False):
            draughts = [1e3 * draught for draught in series[f"afloat_{density:g}"]]
            afloat.plot(series["afloat_times"], draughts, dash, color=colour, linewidth=1.0)
    neutral.axhline(1e3 * results[0].settings["spacing_m"], color=THEORY, linewidth=1.0, label="one spacing")
    label_axes(neutral, "time [s]", "way [mm]", "neutral sphere (solid) and duck (dashed)")
    for density in results[0].settings["floating_densities"]:
        exact = 1e3 * density / 1000.0 * results[0].settings["box_m"][2]
        afloat.axhline(exact, color=THEORY, linewidth=1.0)
    densities = ", ".join(f"{density:g}" for density in results[0].settings["floating_densities"])
    label_axes(afloat, "time [s]", "draught [mm]; black: theory", f"floating box, {densities} kg/m³", legend=False)
    return figure


def draw_bunny_energy(results: Sequence[CaseResult]) -> Figure:
    """Mechanical and kinetic energy over time."""
    figure, (total, kinetic) = make_panels(2, width=4.2, height=3.0)
    for result in results:
        times = result.series["times"]
        total.plot(times, result.series["kept"], **style_of(result))
        if "kept_with_equal_viscosity" in result.series:
            alike = result.series["kept_with_equal_viscosity"]
            total.plot(times, alike, ":", color=COLOURS[result.solver], label="WCSPH, viscosity of the others")
        kinetic.plot(result.series["times"], result.series["kinetic"], **style_of(result))
    for axes in (total, kinetic):
        axes.set_ylim(bottom=0.0)
    label_axes(total, "time [s]", "energy / that of the start", "mechanical energy")
    label_axes(kinetic, "time [s]", "kinetic energy / energy of the start", "kinetic energy")
    return figure


def draw_cloth(results: Sequence[CaseResult]) -> Figure:
    """Stretch of a column by rows, refinement of a band's sag, energy of a swinging sheet, crossings of a folded."""
    figure, (column, order, energy, folded) = make_panels(4)
    series = results[0].series
    for name, label, shade in (("xpbd", "XPBD, cotton", SHADES[0]), ("explicit", "explicit, 60 N/m", SHADES[1])):
        relative = [100.0 * (ratio - 1.0) for ratio in series[f"ratio_{name}"]]
        column.plot(series[f"rows_{name}"], relative, "o-", markersize=3, color=shade, label=label)
    column.axhspan(-1.0, 1.0, color="#eeeeee", zorder=0)
    column.set_ylim(-1.5, 1.5)
    label_axes(column, "row from above", "stretch / theory - 1  [%]", "hanging column; grey: 1 %")
    spacings = [1.0 / count for count in series["cells"]]
    order.loglog(spacings, series["errors"], "o-", markersize=4, color=SHADES[0], label="band between two bars")
    draw_order(order, spacings, max(series["errors"]), 2)
    order.set_xticks(spacings, [f"1/{count}" for count in series["cells"]], minor=False)
    order.set_xticks([], minor=True)
    label_axes(order, "spacing / span", "error of the sag [m]", "refinement")
    energy.plot(series["times"], [100.0 * each for each in series["energies"]], color=SHADES[0], linewidth=0.8)
    energy.set_ylim(-1.0, 1.0)
    label_axes(energy, "time [s]", "energy - start / (m g L/2)  [%]", "undamped sheet, explicit", legend=False)
    times, nodes = series["folded_times"], results[0].settings["folded_nodes_along"]
    folded.plot(times, series["folded_contacts"], color=SHADES[1], label="contacts a substep")
    folded.plot(times, series["folded_crossings"], color=SHADES[0], label="edges through triangles")
    most = max(series["folded_contacts"])
    folded.set_ylim(-0.05 * most, 1.4 * most)
    label_axes(folded, "time [s]", "number", f"folded drop, {nodes} x {nodes} nodes", legend="upper right")
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
    **figures_smoke.DRAWINGS,
}
