"""Draws the figures of smoke."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from matplotlib.figure import Figure

from benchmarks.validation.checks import CaseResult
from benchmarks.validation.figure_style import (
    COLOURS,
    SHADES,
    THEORY,
    TITLES,
    draw_order,
    label_axes,
    make_panels,
    style_of,
)


def draw_smoke_vortices(results: Sequence[CaseResult]) -> Figure:
    """Refinement of a turning blob and of vortices, energy of a lone vortex with confinement."""
    figure, (blob, vortices, energy) = make_panels(3)
    for result in results:
        series, style = result.series, {**style_of(result), "markersize": 4}
        plane = [1.0 / count for count in series["plane_cells"]]
        space = [1.0 / count for count in series["space_cells"]]
        blob.loglog(plane, series["rotation_errors"], "o-", **style)
        vortices.loglog(plane, series["plane_errors"], "o-", **style)
        vortices.loglog(space, series["space_errors"], "s--", markersize=4, color=COLOURS[result.solver])
    draw_order(blob, plane, max(results[0].series["rotation_errors"]), 2)
    draw_order(vortices, plane, max(results[0].series["plane_errors"]), 1)
    for axes, spacings in ((blob, plane), (vortices, sorted({*plane, *space}))):
        axes.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
        axes.set_xticks([], minor=True)
    label_axes(blob, "cell / box", "mean error / mean", "blob, one turn")
    label_axes(vortices, "cell / box", "rms error / rms", "vortices: plane (solid), in space (dashed)")
    shown = results[0]
    for strength, shade in zip((0.0, *shown.settings["strengths"]), SHADES, strict=False):
        energy.plot(
            shown.series["times"], shown.series[f"energy_{strength:g}"], color=shade, label=f"eps = {strength:g}"
        )
    label_axes(energy, "time [s]", "kinetic energy / at first", f"lone vortex, {TITLES[shown.solver]}")
    return figure


def draw_smoke_projection(results: Sequence[CaseResult]) -> Figure:
    """Divergence left by each iteration, and refinement against an exact projection."""
    figure, (left, order) = make_panels(2, width=4.2)
    series, settings = results[0].series, results[0].settings
    finest = max(settings["rough_cells"])
    histories = [name for name in series if name.startswith("left, ") and name.endswith(f", {finest}")]
    for name, shade in zip(histories, SHADES, strict=False):
        left.semilogy(series[name], "o-", markersize=4, color=shade, label=name.split(", ")[1])
    left.axhline(settings["tolerance"], color=THEORY, linewidth=1.0, linestyle="--")
    label_axes(left, "iteration", "max|div u| h / max|u|", f"jet with noise, {finest}³ cells; dashed: goal")
    spacings = [1.0 / count for count in series["cells"]]
    for name, shade in (("walls", SHADES[0]), ("open sides", SHADES[1])):
        order.loglog(spacings, series[f"errors, {name}"], "o-", markersize=4, color=shade, label=name)
    draw_order(order, spacings, max(series["errors, open sides"]), 2)
    order.set_xticks(spacings, [f"1/{count}" for count in series["cells"]], minor=False)
    order.set_xticks([], minor=True)
    label_axes(order, "cell / box", "rms error / rms", "exact projection")
    return figure


def draw_smoke_plume(results: Sequence[CaseResult]) -> Figure:
    """Rise of a thermal at several resolutions, and smoke over what was emitted."""
    figure, (rise, kept) = make_panels(2, width=4.2)
    series = results[0].series
    for count, shade in zip(series["cells"], SHADES, strict=False):
        rise.plot(series["thermal_times"], series[f"rises_{count}"], "o-", markersize=3, color=shade,
                  label=f"{count} cells a metre")  # fmt: skip
    label_axes(rise, "time [s]", "rise of its centre [m]", "thermal")
    kept.plot(series["times"], series["kept_closed"], color=SHADES[0], label="closed box")
    kept.plot(series["times"], series["kept_around"], color=SHADES[1], label="open box, past a ball")
    kept.axhspan(0.99, 1.01, color="#eeeeee", zorder=0)
    kept.set_ylim(0.97, 1.03)
    label_axes(kept, "time [s]", "smoke / emitted smoke", "balance; grey: 1 %")
    return figure


def draw_smoke_front(results: Sequence[CaseResult]) -> Figure:
    """Height of the front of a plume at several resolutions."""
    figure, (front,) = make_panels(1, width=4.2)
    series = results[0].series
    for count, shade in zip(series["cells"], SHADES, strict=False):
        front.plot(series["times"], series[f"front_{count}"], "o-", markersize=3, color=shade,
                   label=f"{count} cells a metre")  # fmt: skip
    label_axes(front, "time [s]", "height of the front [m]", "plume from a smooth source")
    return figure


def draw_smoke_mass(results: Sequence[CaseResult]) -> Figure:
    """Smoke left in an even wind, balance of a plume that leaves, smoke around a moving ball."""
    figure, (blown, leaving, stirred) = make_panels(3)
    series = results[0].series
    counts = results[0].settings["blob_cells"]
    for count, shade in zip(counts, SHADES, strict=False):
        blown.plot(series[f"blown_times_{count}"], series[f"blown_kept_{count}"], color=shade, label=f"{count} cells")
    blown.plot(series[f"blown_times_{counts[-1]}"], series[f"blown_exact_{counts[-1]}"], ":", color=THEORY,
               label="exact")  # fmt: skip
    label_axes(blown, "time [s]", "smoke / at first", "blob in even wind")
    leaving.plot(series["leaving_times"], series["leaving_kept"], color=SHADES[0], label="in the box")
    leaving.plot(series["leaving_times"], series["leaving_balance"], color=SHADES[1], label="and what left")
    leaving.set_ylim(bottom=0.0)
    label_axes(leaving, "time [s]", "smoke / emitted smoke", "plume, open box")
    stirred.plot(series["stirred_times"], series["stirred_kept"], color=SHADES[0], label="in the box")
    for name, shade in (("covered", SHADES[1]), ("uncovered", SHADES[2])):
        stirred.plot(series["stirred_times"], series[f"stirred_{name}"], color=shade, label=name)
    stirred.set_ylim(bottom=0.0)
    label_axes(stirred, "time [s]", "smoke / emitted smoke", "moving ball, closed box")
    return figure


DRAWINGS: dict[str, Callable[[Sequence[CaseResult]], Figure]] = {
    "smoke-vortices": draw_smoke_vortices,
    "smoke-projection": draw_smoke_projection,
    "smoke-plume": draw_smoke_plume,
    "smoke-front": draw_smoke_front,
    "smoke-mass": draw_smoke_mass,
}
