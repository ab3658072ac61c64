"""What the figures share: one colour a solver, small panels, named axes, and lines of an order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
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


def make_panels(count: int, *, width: float = 3.4, height: float = 2.7) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels side by side; width and height of each [inches]."""
    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, [figure.add_subplot(1, count, number + 1) for number in range(count)]


def label_axes(axes: Axes, x: str, y: str, title: str = "", *, legend: bool | str = True) -> None:
    """Name the axes and the panel; the legend goes where it is told, or wherever there is room."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left")
    if legend:
        axes.legend(loc="best" if legend is True else legend)


def style_of(result: CaseResult) -> dict[str, Any]:
    """Colour and label of a result's curves."""
    return {"color": COLOURS[result.solver], "label": TITLES[result.solver]}


def draw_order(axes: Axes, spacings: Sequence[float], largest: float, order: int) -> None:
    """A dashed line of that slope beside the errors."""
    line = [largest * (spacing / max(spacings)) ** order for spacing in spacings]
    axes.plot(spacings, line, "--", color=THEORY, linewidth=1.0, label=f"order {order}")


def draw_refinement(axes: Axes, results: Sequence[CaseResult], counts: str, order: int, x: str, y: str) -> None:
    """Errors of all results over their spacings, 1 over the series `counts`, beside a line of that order."""
    for result in results:
        spacings = [1.0 / count for count in result.series[counts]]
        axes.loglog(spacings, result.series["errors"], "o-", markersize=4, **style_of(result))
    largest = max(max(result.series["errors"]) for result in results)
    draw_order(axes, spacings, largest, order)
    axes.set_xticks(spacings, [f"1/{round(1 / spacing)}" for spacing in spacings], minor=False)
    axes.set_xticks([], minor=True)
    label_axes(axes, x, y, "refinement")
