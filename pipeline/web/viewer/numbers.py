"""The solvers' numbers beside the picture: those of the frame as a table, one of them as a plot over all frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

from pipeline.base.quantities import MECHANICAL_ENERGY, PARTS_OF_ENERGY, SHARE, in_order, quantity
from pipeline.store.cache import FrameNumbers

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 340.0, 130.0, 46.0, 8.0, 8.0, 20.0
MOST_POINTS = 300
FIRST_CHOICES = ("kinetic_energy", "density_error", "divergence", "iterations", "max_speed")
"""Plotted before anybody chooses: the first of these that there is."""


class SolverSeries:
    """The numbers of all frames that have been read, by frame.

    Attributes:
        version: grows with every change.
    """

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
                found.setdefault(solver, set()).update(_with_energy(of))
        return [(solver, name) for solver, of in found.items() for name in in_order(of)]

    def first_choice(self) -> tuple[str, str] | None:
        """Number that is plotted before anybody chooses."""
        names = self.names()
        for wanted in FIRST_CHOICES:
            for solver, name in names:
                if name == wanted:
                    return solver, name
        return names[0] if names else None

    def of(self, solver: str, name: str) -> tuple[list[int], list[float]]:
        """Frames, and the number of a solver at each, shares in per cent."""
        kind = next((each.kinds.get(solver) for each in self._frames.values()), None)
        scale = 100.0 if quantity(name, of_kind=kind).unit == SHARE else 1.0
        frames, values = [], []
        for frame in sorted(self._frames):
            of = _with_energy(self._frames[frame].solvers.get(solver, {}))
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
        values = _with_energy(of)
        rows = "".join(
            f"<tr><td>{escape(known.label)}</td><td>{escape(known.text(values[known.name]))}</td></tr>"
            for known in (quantity(name, of_kind=kind) for name in in_order(values))
        )
        parts.append(f"<b>{escape(solver)}</b><table>{rows}</table>")
    style = (
        "<style>.numbers{font-size:12px;line-height:1.35;padding:0 .8em}.numbers table{width:100%;margin:.1em 0 .7em}"
        ".numbers td{padding:0}.numbers td+td{text-align:right;font-variant-numeric:tabular-nums}</style>"
    )
    return f'{style}<div class="numbers">{"".join(parts)}</div>'


def plot(frames: Sequence[int], values: Sequence[float], *, current: int | None, last: int) -> str:
    """A number over the frames as an SVG element, with a mark at the frame that is seen.

    Args:
        frames: rising.
        values: as many, finite.
        current: the frame that is seen.
        last: the film's last frame, where the axis ends.
    """
    if not frames:
        return '<div style="padding:0 .8em;opacity:.6;font-size:12px">nothing to plot yet</div>'
    low, high = min(0.0, *values), max(0.0, *values)
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-290):
        high = low + 1.0
    width, height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def place(frame: float, value: float) -> tuple[float, float]:
        x = LEFT + width * (frame / max(last, 1))
        return x, TOP + height * (1.0 - (value - low) / (high - low))

    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*each) for each in _thinned(frames, values)))
    base = place(0, 0.0)[1]
    labels = {base: "0", TOP + 7: f"{high:.3g}"} if high > 0.0 else {TOP + 7: "0", TOP + height: f"{low:.3g}"}
    parts = [
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" style="display:block;width:100%;font:10px system-ui" '
        f'fill="currentColor" role="img">',
        f'<line x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{base:.1f}" y2="{base:.1f}" stroke="currentColor" '
        'opacity=".3"/>',
        *(
            f'<text x="{LEFT - 5:g}" y="{y:.1f}" text-anchor="end" opacity=".7">{text}</text>'
            for y, text in labels.items()
        ),
        f'<text x="{LEFT:g}" y="{HEIGHT - 6:g}" opacity=".7">frame 0</text>',
        f'<text x="{WIDTH - RIGHT:g}" y="{HEIGHT - 6:g}" text-anchor="end" opacity=".7">{last}</text>',
        f'<polyline points="{line}" fill="none" stroke="#3f97e0" stroke-width="1.6" stroke-linejoin="round"/>',
    ]
    if current is not None:
        x, _ = place(current, 0.0)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP:g}" y2="{TOP + height:g}" stroke="#f08a3c"/>')
        if current in frames:
            value = values[frames.index(current)]
            _, y = place(current, value)
            anchor, shift = ("end", -6) if x > WIDTH / 2 else ("start", 6)
            parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#f08a3c"/>'
                f'<text x="{x + shift:.1f}" y="{max(y - 5, TOP + 8):.1f}" text-anchor="{anchor}" '
                f'fill="#f08a3c">{value:.4g}</text>'
            )
    return "".join([*parts, "</svg>"])


def _thinned(frames: Sequence[int], values: Sequence[float]) -> list[tuple[int, float]]:
    """The lowest and the highest of each piece of a long film, so that no peak is lost."""
    pairs = list(zip(frames, values, strict=True))
    if len(pairs) <= MOST_POINTS:
        return pairs
    size = math.ceil(2 * len(pairs) / MOST_POINTS)
    kept: list[tuple[int, float]] = []
    for start in range(0, len(pairs), size):
        piece = pairs[start : start + size]
        kept += sorted({min(piece, key=lambda each: each[1]), max(piece, key=lambda each: each[1])})
    return kept


def _with_energy(of: Mapping[str, float]) -> dict[str, float]:
    """A solver's numbers, and its mechanical energy where it tells its parts."""
    if not {"kinetic_energy", "potential_energy"} <= set(of):
        return dict(of)
    return {**of, MECHANICAL_ENERGY: sum(of.get(part, 0.0) for part in PARTS_OF_ENERGY)}
