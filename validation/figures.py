"""What the figures share: one colour a solver, small panels, named axes, and lines of an order."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from validation.checks import TITLES, CaseResult

THEORY = "#222222"
SHADES = ("#2a6fbb", "#d1652b", "#2f8f5b", "#8a5fb0")
FINER = ("#a9c8ea", "#5f9bd6", "#1d4f86")  # of one curve at finer and finer resolutions
COLOURS = {**dict.fromkeys(TITLES, SHADES[0]), "dfsph": SHADES[1], "pcisph": SHADES[2], "semi_lagrangian": SHADES[1]}

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


def plot_each(
    axes: Axes,
    series: Mapping[str, Sequence[float]],
    x: str,
    names: Mapping[str, str],
    *,
    scale: float = 1.0,
    **how: Any,
) -> None:
    """One curve a name of the series over that of x, in shades, with a label each; their values are scaled."""
    for (name, label), shade in zip(names.items(), SHADES, strict=False):
        values = [scale * value for value in series[name]]
        axes.plot(series[x], values, **{"color": shade, "label": label or None, **how})


def draw_refinement(
    axes: Axes,
    curves: Sequence[tuple[Sequence[float], Sequence[float], Mapping[str, Any]]],
    order: int,
    x: str,
    y: str,
    *,
    title: str = "refinement",
    tick: Callable[[float], str] = lambda spacing: f"1/{round(1 / spacing)}",
) -> None:
    """Curves of spacings, errors and a style beside a dashed line of an order; `tick` writes a spacing."""
    for spacings, errors, style in curves:
        axes.loglog(spacings, errors, **{"linestyle": "-", "marker": "o", "markersize": 4, **style})
    everywhere = sorted({spacing for spacings, _, _ in curves for spacing in spacings}, reverse=True)
    spacings, errors, _ = curves[0]
    line = [max(errors) * (spacing / max(spacings)) ** order for spacing in spacings]
    axes.plot(spacings, line, "--", color=THEORY, linewidth=1.0, label=f"order {order}")
    axes.set_xticks(everywhere, [tick(spacing) for spacing in everywhere], minor=False)
    axes.set_xticks([], minor=True)
    label_axes(axes, x, y, title)


def refinement_of(results: Sequence[CaseResult], counts: str, errors: str = "errors") -> list[Any]:
    """Curves of a refinement, one a solver: errors over 1 over the series `counts`."""
    return [([1.0 / n for n in each.series[counts]], each.series[errors], style_of(each)) for each in results]
