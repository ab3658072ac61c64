"""Line charts of the report. uPlot draws them in the browser: a drag zooms, hovering tells the values."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

SMALLEST = 1.0e-290  # what is smaller counts as zero: parts of it cannot be told from zero in double precision
LOGARITHMIC_FROM = 30.0  # ratio of the largest to the smallest value from which an axis that may be logarithmic is


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart."""

    label: str  # in the legend
    x: Sequence[float]  # rising
    y: Sequence[float]  # as many; what is not finite leaves a gap
    color: int = 0  # index of its colour
    dash: int = 0  # index of its dashes


def chart(lines: Sequence[Line], *, x_label: str, may_be_logarithmic: bool = False) -> dict[str, object]:
    """A chart of lines, of which one has a finite value at least, as `report.js` takes it.

    `may_be_logarithmic`: use a logarithmic y axis where positive values differ by much; zeros then leave gaps.
    """
    values = [y for line in lines for y in line.y if math.isfinite(y)]
    positive = [value for value in values if value > SMALLEST]
    logarithmic = bool(
        may_be_logarithmic and positive and min(values) >= 0.0 and max(positive) >= LOGARITHMIC_FROM * min(positive)
    )
    return {
        "x_label": x_label,
        "logarithmic": logarithmic,
        "lines": [
            {
                "label": line.label,
                "x": list(line.x),
                "y": [y if not logarithmic or y > SMALLEST else None for y in line.y],
                "color": line.color,
                "dash": line.dash,
            }
            for line in lines
        ],
    }


@cache
def style() -> str:
    """The style of charts."""
    return files(__package__).joinpath("uplot/uPlot.min.css").read_text(encoding="utf-8")


@cache
def scripts() -> tuple[str, str]:
    """The only scripts of a report: uPlot with its licence, and what draws the charts of the page with it."""
    folder = files(__package__)
    licence = folder.joinpath("uplot/LICENSE").read_text(encoding="utf-8")
    uplot = folder.joinpath("uplot/uPlot.iife.min.js").read_text(encoding="utf-8")
    return f"/*! uPlot\n{licence}*/\n{uplot}", folder.joinpath("report.js").read_text(encoding="utf-8")
