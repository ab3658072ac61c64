"""The solvers' numbers beside the picture: those of the frame as a table, one of them as a plot over all frames."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.quantities import in_order, quantity, with_energy
from pipeline.store.cache import FrameNumbers

FIRST_CHOICES = ("kinetic_energy", "density_error", "divergence", "iterations", "max_speed")
"""Plotted before anybody chooses: the first of these that there is."""
TABLE_STYLE = (
    "<style>.numbers{font-size:12px;line-height:1.35;padding:0 .8em}.numbers table{width:100%;margin:.1em 0 .7em}"
    ".numbers td{padding:0}.numbers td+td{text-align:right;font-variant-numeric:tabular-nums}</style>"
)


class SolverSeries:
    """The numbers of all frames that have been read, by frame; `version` grows with every change."""

    def __init__(self) -> None:
        self._frames: dict[int, FrameNumbers] = {}
        self._sources: dict[int, str] = {}
        self.version = 0
        self._largest: dict[str, tuple[int, float]] = {}  # by name: of which version, and what

    def put(self, numbers: FrameNumbers, *, source: str) -> None:
        """Add a frame, or replace it; `source` is the hash of the file that it was read from."""
        self._frames[numbers.frame] = numbers
        self._sources[numbers.frame] = source
        self.version += 1

    def numbers(self, frame: int | None) -> FrameNumbers | None:
        """Those of a frame, None if they were not read."""
        return None if frame is None else self._frames.get(frame)

    def keep(self, frames: Sequence[int]) -> None:
        """Forget all other frames."""
        self._frames = {frame: self._frames[frame] for frame in frames if frame in self._frames}
        self.version += 1

    def has(self, frame: int, *, source: str) -> bool:
        """Whether a frame has been read from the file with this hash."""
        return frame in self._frames and self._sources[frame] == source

    def names(self) -> list[tuple[str, str]]:
        """Every solver with each of its numbers, in the order in which they are shown."""
        found: dict[str, set[str]] = {}
        for frame in self._frames.values():
            for solver, of in frame.solvers.items():
                found.setdefault(solver, set()).update(with_energy(of))
        return [(solver, name) for solver, of in found.items() for name in in_order(of)]

    def first_choice(self) -> tuple[str, str] | None:
        """Number that is plotted before anybody chooses."""
        names = self.names()
        wanted = (each for choice in FIRST_CHOICES for each in names if each[1] == choice)
        return next(wanted, names[0] if names else None)

    def of(self, solver: str, name: str) -> tuple[list[int], list[float]]:
        """Frames, and the number of a solver at each, shares in per cent."""
        kind = next((each.kinds.get(solver) for each in self._frames.values()), None)
        scale = quantity(name, of_kind=kind).scale
        frames, values = [], []
        for frame in sorted(self._frames):
            of = with_energy(self._frames[frame].solvers.get(solver, {}))
            if name in of and math.isfinite(of[name]):
                frames.append(frame)
                values.append(scale * of[name])
        return frames, values

    def largest(self, name: str) -> float:
        """Of all solvers and frames; 0 if nobody tells it."""
        if self._largest.get(name, (-1, 0.0))[0] != self.version:
            values = [of[name] for each in self._frames.values() for of in each.solvers.values() if name in of]
            self._largest[name] = (self.version, max(filter(math.isfinite, values), default=0.0))
        return self._largest[name][1]


def label(solver: str, name: str) -> str:
    """A number of a solver in words: `water: kinetic energy [J]`."""
    known = quantity(name)
    unit = f" [{known.unit}]" if known.unit else ""
    return f"{solver}: {known.label}{unit}"


def table(numbers: FrameNumbers) -> str:
    """All numbers of a frame as HTML."""
    parts = []
    for solver, of in numbers.solvers.items():
        kind = numbers.kinds.get(solver)
        values = with_energy(of)
        rows = "".join(
            f"<tr><td>{escape(known.label)}</td><td>{escape(known.text(values[known.name]))}</td></tr>"
            for known in (quantity(name, of_kind=kind) for name in in_order(values))
        )
        parts.append(f"<b>{escape(solver)}</b><table>{rows}</table>")
    return f'{TABLE_STYLE}<div class="numbers">{"".join(parts)}</div>'


def plot_data(frames: Sequence[int], values: Sequence[float], current: int | None) -> tuple[NDArray[np.float64], ...]:
    """A finite number over rising frames as uPlot takes it: frames, values, and values up to the current frame.

    These stay at the current frame's value after it, as uPlot's scales bear no NaN.
    """
    x, y = np.asarray(frames, float), np.asarray(values, float)
    now = frames.index(current) if current in frames else -1
    return x, y, y[np.clip(np.arange(len(y)), 0, now)] if now >= 0 else y


def plot_series(name: str) -> tuple[Any, ...]:
    """What uPlot draws of `plot_data`: the number, and over it how far the film is and at what value."""
    return (
        {"label": "frame"},
        {"label": name, "stroke": "#3f97e0", "width": 1.5},
        {"label": "up to this frame", "stroke": "#f08a3c", "width": 1.5, "points": {"show": False}},
    )
