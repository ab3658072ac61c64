"""The solvers' numbers of a job, frame by frame, as its files have them; and what in them is worth a warning."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.quantities import WARNINGS, CountedEvent, in_order, quantity
from pipeline.base.task import ArtifactPath
from pipeline.record.reader import ManifestReader
from pipeline.run.events import Committed, RunEvent
from pipeline.run.plan import frame_ranges
from pipeline.store.cache import FrameNumbers, read_numbers
from pipeline.store.receipts import Receipt, of_newest, read_receipt
from render.errors import InvalidFileError
from render.point_clouds import read_point_counts
from sim.core.solver import Diagnostics

SIMULATE = "simulate"  # the stage whose artifacts are frames of the cache
WHITEWATER = "whitewater"
LINE_WIDTH = 100
NUMBERS_OF_WARNINGS = [event.name for event in WARNINGS] + [
    measure for event in WARNINGS for measure in event.measured_by.values()
]
NUMBERS_OF_WARNINGS += [f"{event.named_by}*" for event in WARNINGS if event.named_by]
"""What `count_warnings` needs of a frame."""
_TIED = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True, slots=True)
class SimulationNumbers:
    """What the solvers told of a simulation, and what its whitewater came to."""

    # of each committed frame that can be read, in order; maybe only what warnings need
    frames: tuple[FrameNumbers, ...] = ()
    last: FrameNumbers | None = None  # all numbers of the last of them
    unreadable: tuple[int, ...] = ()  # frames that were committed and cannot be read any more
    unreadable_whitewater: tuple[ArtifactPath, ...] = ()  # files of whitewater, likewise

    def warnings(self) -> list[CountedWarning]:
        """What happened in these frames that should not, by solver."""
        return count_warnings(self.frames)

    def lines(self) -> list[str]:
        """The last frame's numbers for people, by solver, and which frames could not be read."""
        lines = [] if self.last is None else describe(self.last)
        if self.unreadable:
            lines.append(f"frames of the cache that cannot be read: {_ranges(self.unreadable)}; see: pipeline verify")
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
class CountedWarning:
    """An event of a solver that should not happen, how often it did over all frames, and in which."""

    solver: str
    kind: str  # of the solver's bodies
    event: CountedEvent
    count: int
    frames: tuple[int, ...]
    worst: float | None = None  # the largest number in these frames of what the event is measured by
    names: tuple[str, ...] = ()  # to whom it happened, if that is told

    def __str__(self) -> str:
        """`water: 3 solves hit their iteration limit, frames 12, 15-16`, and what that means."""
        plural = "s" if len(self.frames) > 1 else ""
        who = f" ({', '.join(self.names)})" if self.names else ""
        told = f"{self.solver}: {self.event.text(self.count)}{who}, frame{plural} {_ranges(self.frames)}"
        meaning = self.event.means.get(self.kind)
        if meaning is None:
            return told
        measure = self.event.measured_by.get(self.kind)
        if measure is not None:
            meaning = meaning.format(worst=quantity(measure, of_kind=self.kind).text(self.worst or 0.0))
        return f"{told}: {meaning}"

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

    With `history` all numbers of all frames; else all of the last frame, and of the others what warnings need.

    Raises ManifestError: the record, which tells the fluids with whitewater, cannot be read.
    """
    only = None if history else NUMBERS_OF_WARNINGS
    receipts = of_newest({_frame_of(each.artifact): each for each in _receipts(layout, layout.frame_cache(0))})
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        whitewater, unreadable_files = _whitewater_numbers(layout, receipts, manifest.subjects(WHITEWATER))

    def numbers(receipt: Receipt, only: list[str] | None) -> FrameNumbers:
        of_cache = read_numbers(layout.path(receipt.artifact), only)
        return replace(of_cache, solvers={**of_cache.solvers, **whitewater.get(of_cache.frame, {})})

    frames: list[FrameNumbers] = []
    unreadable: list[int] = []
    for frame, receipt in receipts.items():
        try:
            frames.append(numbers(receipt, only))
        except InvalidArtifactError:
            unreadable.append(frame)
    last = numbers(receipts[frames[-1].frame], None) if frames else None
    return SimulationNumbers(tuple(frames), last, tuple(unreadable), tuple(unreadable_files))


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


def count_warnings(frames: Iterable[FrameNumbers]) -> list[CountedWarning]:
    """What happened in these frames that should not, by solver."""
    counts: dict[tuple[str, str, CountedEvent], dict[int, int]] = {}
    measured: dict[tuple[str, str, CountedEvent], float] = {}
    names: dict[tuple[str, str, CountedEvent], dict[str, None]] = {}
    totals: dict[tuple[str, CountedEvent], int] = {}
    for each in frames:
        for solver, event, count in _events_of(each.solvers):
            news = count - totals.get((solver, event), 0) if event.running_total else count
            totals[solver, event] = count
            if news > 0:
                kind = each.kinds.get(solver, solver)  # solvers of several bodies have the names of their kinds
                counts.setdefault((solver, kind, event), {})[each.frame] = news
                if (worst := _measured(event, kind, each.solvers[solver])) is not None:
                    measured[solver, kind, event] = max(worst, measured.get((solver, kind, event), 0.0))
                names.setdefault((solver, kind, event), {}).update(dict.fromkeys(_names(event, each.solvers[solver])))
    return [
        CountedWarning(*of, sum(news.values()), tuple(news), measured.get(of), tuple(names.get(of, ())))
        for of, news in counts.items()
    ]


def _names(event: CountedEvent, of: Diagnostics) -> list[str]:
    """To whom an event happened by a solver's numbers, most often first, if that is told."""
    if not event.named_by:
        return []
    found = [name for name in of if name.startswith(event.named_by)]
    return [name.removeprefix(event.named_by) for name in sorted(found, key=lambda name: -of[name])]


def _measured(event: CountedEvent, kind: str, of: Diagnostics) -> float | None:
    """How bad an event was by a solver's numbers, if it is measured."""
    measure = event.measured_by.get(kind)
    return None if measure is None else of.get(measure)


def unreadable_whitewater(files: Iterable[ArtifactPath]) -> list[str]:
    """`whitewater of water that cannot be read: frames 3, 7-9`, a sentence for each fluid."""
    frames: defaultdict[str, list[int]] = defaultdict(list)
    for artifact in files:
        frames[_whitewater_solver(artifact)].append(_frame_of(artifact))
    return [
        f"{solver} that cannot be read: frame{'s' if len(of) > 1 else ''} {_ranges(of)}"
        for solver, of in frames.items()
    ]


class SolverWatch:
    """Observer of a run for what the solvers warn of; it tells each kind once, when it first happens."""

    def __init__(self, layout: JobLayout, say: Callable[[str], None]) -> None:
        self._layout = layout
        self._say = say
        self._told: set[tuple[str, str]] = set()

    def notify(self, event: RunEvent) -> None:
        """Look at every frame, and every file of whitewater, that is committed."""
        if not isinstance(event, Committed) or event.receipt.stage not in (SIMULATE, WHITEWATER):
            return
        artifact = event.receipt.artifact
        try:
            if event.receipt.stage == SIMULATE:
                numbers = read_numbers(self._layout.path(artifact))
                solvers, kinds = numbers.solvers, numbers.kinds
            else:
                solvers, kinds = {_whitewater_solver(artifact): _read_whitewater(self._layout, artifact)}, {}
        except InvalidArtifactError as error:
            self._say(str(error))
            return
        for solver, happened, count in _events_of(solvers):
            if (solver, happened.name) not in self._told:
                self._told.add((solver, happened.name))
                kind, frame = kinds.get(solver, solver), _frame_of(artifact)
                worst = _measured(happened, kind, solvers[solver])
                names = tuple(_names(happened, solvers[solver]))
                warning = CountedWarning(solver, kind, happened, count, (frame,), worst, names)
                self._say(f"{warning}; later ones are counted: pipeline status")


def _events_of(solvers: Mapping[str, Diagnostics]) -> list[tuple[str, CountedEvent, int]]:
    return [
        (solver, event, int(of[event.name]))
        for solver, of in solvers.items()
        for event in WARNINGS
        if of.get(event.name, 0.0) > 0.0
    ]


def _ranges(frames: Collection[int]) -> str:
    return frame_ranges(frames, range(min(frames), max(frames) + 1))


# --- files ---


def _receipts(layout: JobLayout, first: ArtifactPath) -> list[Receipt]:
    """Receipts of all frames' files beside the one of the first frame."""
    artifacts = (
        ArtifactPath(path.relative_to(layout.receipts).as_posix().removesuffix(".json"))
        for path in sorted(layout.receipt(first).parent.glob("[0-9]*.json"))
    )
    return [receipt for receipt in (read_receipt(layout, artifact) for artifact in artifacts) if receipt]


def _whitewater_numbers(
    layout: JobLayout, cached: Mapping[int, Receipt], fluids: Collection[str]
) -> tuple[dict[int, dict[str, Diagnostics]], list[ArtifactPath]]:
    """The numbers of all whitewater that was made from these frames, with the parameters of the newest.

    Other rates or speeds make other numbers, of frames that are to be redone; fingerprints do not tell that, as each
    frame has its own. Files of other frames and fluids are left over from an earlier version of the job.

    Returns:
        Numbers by frame and by what tells them, and the files that cannot be read.
    """
    numbers: defaultdict[int, dict[str, Diagnostics]] = defaultdict(dict)
    unreadable = []
    for fluid in sorted(fluids):
        receipts = _receipts(layout, layout.whitewater(fluid, 0))
        newest = max(receipts, key=lambda receipt: receipt.finished, default=None)
        for receipt in receipts:
            frame = cached.get(_frame_of(receipt.artifact))
            is_current = newest is not None and receipt.parameters == newest.parameters
            if frame is None or not is_current or receipt.inputs.get(frame.artifact) != frame.hash:
                continue
            solver = _whitewater_solver(receipt.artifact)
            try:
                numbers[_frame_of(receipt.artifact)][solver] = _read_whitewater(layout, receipt.artifact)
            except InvalidArtifactError:
                unreadable.append(receipt.artifact)
    return numbers, unreadable


def _read_whitewater(layout: JobLayout, artifact: ArtifactPath) -> Diagnostics:
    """How many particles a file of whitewater has, and how many had no room, as its header tells.

    Raises InvalidArtifactError: it cannot be read.
    """
    try:
        counts = read_point_counts(layout.path(artifact))
    except (OSError, InvalidFileError) as error:
        raise InvalidArtifactError(f"{artifact}: its header cannot be read: {error}") from error
    capped = {} if counts.not_made is None else {"whitewater_capped": float(counts.not_made)}
    return {"whitewater_particles": float(counts.points), **capped}


def _whitewater_solver(artifact: ArtifactPath) -> str:
    """What a file's numbers are listed under, beside those of the solvers."""
    return f"whitewater of {artifact.split('/')[1]}"


def _frame_of(artifact: ArtifactPath) -> int:
    return int(artifact.rpartition("/")[2].partition(".")[0])
