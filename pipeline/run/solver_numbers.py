"""The solvers' numbers of a job, frame by frame, as its files have them; and what in them is worth a warning."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.quantities import WARNINGS, CountedEvent, in_order, quantity
from pipeline.base.task import ArtifactPath
from pipeline.record.reader import ManifestReader
from pipeline.run.events import Committed, RunEvent
from pipeline.run.plan import frame_ranges
from pipeline.run.whitewater_numbers import (
    WHITEWATER,
    parts_of,
    read_whitewater_numbers,
    unreadable_whitewater,
    whitewater_numbers,
)
from pipeline.store.cache import FrameNumbers, read_numbers
from pipeline.store.receipts import Receipt, read_receipt
from sim.core.solver import Diagnostics

SIMULATE = "simulate"
"""The stage whose artifacts are frames of the cache."""
LINE_WIDTH = 100
_TIED = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True, slots=True)
class SimulationNumbers:
    """What the solvers told of a simulation, and what its whitewater came to.

    Attributes:
        frames: of each committed frame that can be read, in order; maybe only what warnings need.
        last: all numbers of the last of them.
        unreadable: frames that were committed and cannot be read any more.
        unreadable_whitewater: files of whitewater, likewise.
    """

    frames: tuple[FrameNumbers, ...] = ()
    last: FrameNumbers | None = None
    unreadable: tuple[int, ...] = ()
    unreadable_whitewater: tuple[ArtifactPath, ...] = ()

    def warnings(self) -> list[Warned]:
        """What happened in these frames that should not, by solver."""
        return count_warnings(self.frames)

    def lines(self) -> list[str]:
        """The last frame's numbers for people, by solver, and which frames could not be read."""
        lines = [] if self.last is None else describe(self.last)
        if self.unreadable:
            frames = frame_ranges(self.unreadable, range(min(self.unreadable), max(self.unreadable) + 1))
            lines.append(f"frames of the cache that cannot be read: {frames}; see: pipeline verify")
        lines += [f"{told}; see: pipeline verify" for told in unreadable_whitewater(self.unreadable_whitewater)]
        return lines

    def as_json(self) -> dict[str, object]:
        """The last frame's numbers, and all warnings, for machines."""
        last = self.last
        return {
            "frame": None if last is None else last.frame,
            "time_s": None if last is None else last.time_s,
            "solvers": {} if last is None else {name: dict(of) for name, of in last.solvers.items()},
            "warnings": [each.as_json() for each in self.warnings()],
            "unreadable_frames": list(self.unreadable),
            "unreadable_whitewater": list(self.unreadable_whitewater),
        }


@dataclass(frozen=True, slots=True)
class Warned:
    """Something that should not happen, and how often it did.

    Attributes:
        solver: which solver tells it.
        event: what.
        count: how often, over all frames.
        frames: in which frames.
    """

    solver: str
    event: CountedEvent
    count: int
    frames: tuple[int, ...]

    def __str__(self) -> str:
        """`water: 3 solves hit their iteration limit, frames 12, 15-16`."""
        plural = "s" if len(self.frames) > 1 else ""
        where = frame_ranges(self.frames, range(min(self.frames), max(self.frames) + 1))
        return f"{self.solver}: {self.event.text(self.count)}, frame{plural} {where}"

    def as_json(self) -> dict[str, object]:
        """For machines."""
        return {
            "solver": self.solver,
            "name": self.event.name,
            "count": self.count,
            "frames": list(self.frames),
            "text": str(self),
        }


def simulation_numbers(layout: JobLayout, *, history: bool = False) -> SimulationNumbers:
    """The numbers of all frames that the simulation has committed; not those of an earlier version of it.

    Args:
        layout: the job's folder.
        history: read all numbers of all frames; else all of the last frame, and of the others what warnings need.

    Raises:
        ManifestError: the record, which tells the fluids with whitewater, cannot be read.
    """
    only = None if history else [event.name for event in WARNINGS]
    receipts = _frame_receipts(layout)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        clouds = whitewater_numbers(layout, receipts, manifest.subjects(WHITEWATER))

    def numbers(receipt: Receipt, only: list[str] | None) -> FrameNumbers:
        of_cache = read_numbers(layout.path(receipt.artifact), only)
        return replace(of_cache, solvers={**of_cache.solvers, **clouds.frames.get(of_cache.frame, {})})

    frames: list[FrameNumbers] = []
    unreadable: list[int] = []
    for frame, receipt in receipts.items():
        try:
            frames.append(numbers(receipt, only))
        except InvalidArtifactError:
            unreadable.append(frame)
    last = numbers(receipts[frames[-1].frame], None) if frames else None
    return SimulationNumbers(tuple(frames), last, tuple(unreadable), tuple(clouds.unreadable))


def describe(numbers: FrameNumbers) -> list[str]:
    """A frame's numbers for people: a heading for each solver, and its numbers below, several in a line."""
    lines = []
    for solver, of in numbers.solvers.items():
        lines.append(f"{solver}, frame {numbers.frame} at {numbers.time_s:.4g} s:")
        kind = numbers.kinds.get(solver)
        items = [
            f"{each.label} {each.text(of[each.name])}"
            for each in (quantity(name, of_kind=kind) for name in in_order(of))
        ]
        # A number and its unit stay together.
        text = textwrap.wrap(", ".join(item.replace(" ", _TIED) for item in items), LINE_WIDTH)
        lines += [f"  {line.replace(_TIED, ' ')}" for line in text]
    return lines


def count_warnings(frames: Iterable[FrameNumbers]) -> list[Warned]:
    """What happened in these frames that should not, by solver."""
    counts: dict[tuple[str, CountedEvent], dict[int, int]] = {}
    totals: dict[tuple[str, CountedEvent], int] = {}
    for each in frames:
        for solver, event, count in _events_of(each.solvers):
            news = count - totals.get((solver, event), 0) if event.running_total else count
            totals[solver, event] = count
            if news > 0:
                counts.setdefault((solver, event), {})[each.frame] = news
    return [Warned(solver, event, sum(of.values()), tuple(of)) for (solver, event), of in counts.items()]


class SolverWatch:
    """Watches a run for what the solvers warn of, and tells each kind once, when it first happens."""

    def __init__(self, layout: JobLayout, say: Callable[[str], None]) -> None:
        self._layout = layout
        self._say = say
        self._told: set[tuple[str, str]] = set()

    def notify(self, event: RunEvent) -> None:
        """Look at every frame, and every file of whitewater, that is committed."""
        if not isinstance(event, Committed) or event.receipt.stage not in (SIMULATE, WHITEWATER):
            return
        try:
            frame, solvers = self._numbers_of(event.receipt)
        except InvalidArtifactError as error:
            self._say(str(error))
            return
        for solver, kind, count in _events_of(solvers):
            if (solver, kind.name) not in self._told:
                self._told.add((solver, kind.name))
                self._say(f"{Warned(solver, kind, count, (frame,))}; later ones are counted: pipeline status")

    def _numbers_of(self, receipt: Receipt) -> tuple[int, Mapping[str, Diagnostics]]:
        """The frame that was committed, and its numbers by what tells them."""
        if receipt.stage == SIMULATE:
            numbers = read_numbers(self._layout.path(receipt.artifact))
            return numbers.frame, numbers.solvers
        whitewater = parts_of(receipt.artifact)
        return whitewater.frame, {whitewater.teller: read_whitewater_numbers(self._layout, receipt.artifact)}


def _events_of(solvers: Mapping[str, Diagnostics]) -> list[tuple[str, CountedEvent, int]]:
    return [
        (solver, event, int(of[event.name]))
        for solver, of in solvers.items()
        for event in WARNINGS
        if of.get(event.name, 0.0) > 0.0
    ]


def _frame_receipts(layout: JobLayout) -> Mapping[int, Receipt]:
    """Receipts of the frames with the fingerprint of the one that was committed last, by frame."""
    folder = layout.receipt(layout.frame_cache(0)).parent
    artifacts = [
        ArtifactPath(path.relative_to(layout.receipts).as_posix().removesuffix(".json"))
        for path in sorted(folder.glob("[0-9]*.h5.json"))
    ]
    receipts = [receipt for receipt in (read_receipt(layout, artifact) for artifact in artifacts) if receipt]
    return {_frame_of(receipt): receipt for receipt in _of_last_version(receipts)}


def _of_last_version(receipts: Sequence[Receipt]) -> list[Receipt]:
    if not receipts:
        return []
    fingerprint = max(receipts, key=lambda receipt: receipt.finished).fingerprint
    return [receipt for receipt in receipts if receipt.fingerprint == fingerprint]


def _frame_of(receipt: Receipt) -> int:
    return int(receipt.artifact.rpartition("/")[2].removesuffix(".h5"))
