"""From the solvers' numbers of one or several jobs to charts: one for each kind of quantity. Pure."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pipeline.base.quantities import MECHANICAL_ENERGY, Quantity, in_order, quantity, with_energy
from pipeline.show.report.chart import Line
from pipeline.store.cache import FrameNumbers

LOGARITHMIC_PANELS = frozenset(
    {"Density and divergence error", "Residual", "Divergence", "Substeps per frame", "Smallest time step"}
)
NUMBERS_OF_STEPS = frozenset(
    {"substeps", "smallest_dt_s", "iterations", "divergence_iterations", "viscosity_iterations"}
    | {"density_error", "divergence_error", "residual", "divergence", "neighbor_searches"}
)
"""They say nothing about a frame that took no step, the first one."""
TOTAL_ENERGY = "Total mechanical energy"


@dataclass(frozen=True, slots=True)
class JobNumbers:
    """All that the solvers told of a job."""

    name: str  # of the job, different for each job of a report
    frames: tuple[FrameNumbers, ...]  # that are there, in order

    @property
    def solvers(self) -> list[str]:
        """Names of the solvers, in the order of the first frame."""
        return list(dict.fromkeys(name for frame in self.frames for name in frame.solvers))

    def names(self, solver: str) -> list[str]:
        """Names of a solver's numbers, the mechanical energy among them where it has its parts."""
        return in_order(set().union(*(with_energy(frame.solvers.get(solver, {})) for frame in self.frames)))

    def series(self, solver: str, name: str) -> list[float]:
        """A number of a solver by frame; NaN where it has none."""
        return [_value(frame, solver, name) for frame in self.frames]

    def total_energy(self) -> list[float]:
        """Mechanical energy of all bodies together, by frame [J]; NaN where it is unknown. See `PARTS_OF_ENERGY`."""
        solvers = [solver for solver in self.solvers if MECHANICAL_ENERGY in self.names(solver)]
        if not solvers:
            return [math.nan] * len(self.frames)
        return [sum(_value(frame, each, MECHANICAL_ENERGY) for each in solvers) for frame in self.frames]


@dataclass(frozen=True, slots=True)
class Panel:
    """A chart's worth of lines."""

    title: str  # what kind of quantity
    unit: str  # of the y axis
    lines: tuple[Line, ...]  # at least one
    logarithmic: bool = False  # whether its axis may be logarithmic


@dataclass(frozen=True, slots=True)
class Panels:
    """The charts of a report."""

    panels: tuple[Panel, ...]  # those with something to see
    zero: tuple[str, ...]  # numbers that are zero in every frame of every job, in words


def panels_of(jobs: Sequence[JobNumbers]) -> Panels:
    """One panel for each kind of quantity; every solver of every job is on it.

    Lines of one job alone have a colour for each solver, those of several jobs one for each job; what else is on the
    panel is told apart by dashes.
    """
    found: dict[tuple[str, str], list[_Series]] = {}
    zero: dict[str, bool] = {}
    for index, job in enumerate(jobs):
        for series in _all_series(index, job, several=len(jobs) > 1):
            label = f"{series.solver}: {series.quantity.label}"
            zero[label] = zero.get(label, True) and not _is_seen(series.y)
            found.setdefault((series.quantity.panel, series.quantity.unit), []).append(series)
    place = {
        name: index for index, name in enumerate(in_order({each.quantity.name for of in found.values() for each in of}))
    }
    panels = [
        Panel(title, unit, _lines(of, several=len(jobs) > 1), title in LOGARITHMIC_PANELS)
        for (title, unit), of in sorted(
            found.items(), key=lambda item: min(place[each.quantity.name] for each in item[1])
        )
        if any(_is_seen(series.y) for series in of)
    ]
    total = _total_energy(jobs)
    with_energy = sum(MECHANICAL_ENERGY in job.names(solver) for job in jobs for solver in job.solvers)
    first = [total] if total is not None and (len(jobs) > 1 or with_energy > 1) else []
    return Panels(tuple(first + panels), tuple(label for label, is_zero in zero.items() if is_zero))


@dataclass(frozen=True, slots=True)
class _Series:
    job: int
    job_name: str
    solver: str
    solver_index: int
    quantity: Quantity
    x: list[float]
    y: list[float]


def _all_series(index: int, job: JobNumbers, *, several: bool) -> Iterable[_Series]:
    times = [frame.time_s for frame in job.frames]
    kinds = job.frames[-1].kinds if job.frames else {}
    for solver_index, solver in enumerate(job.solvers):
        for name in job.names(solver):
            known = quantity(name, of_kind=kinds.get(solver))
            values = [known.scale * value for value in job.series(solver, name)]
            if name in NUMBERS_OF_STEPS:
                steps = job.series(solver, "substeps")
                values = [value if count else math.nan for value, count in zip(values, steps, strict=True)]
            if any(map(math.isfinite, values)):
                yield _Series(index, job.name if several else "", solver, solver_index, known, times, values)


def _lines(series: Sequence[_Series], *, several: bool) -> tuple[Line, ...]:
    """Colours and dashes; a label names only what differs within the panel, and the solver in any case."""
    styles: dict[tuple[str, str], int] = {}
    lines = []
    labels = {each.quantity.label for each in series}
    solvers = {each.solver for each in series}
    for each in series:
        what = each.quantity.label if len(labels) > 1 else ""
        dash = styles.setdefault((each.solver if several else "", each.quantity.label), len(styles))
        who = [each.job_name, each.solver if len(solvers) > 1 or not several else "", what]
        color = each.job if several else each.solver_index
        lines.append(Line(", ".join(filter(None, who)), each.x, each.y, color, dash))
    return tuple(lines)


def _total_energy(jobs: Sequence[JobNumbers]) -> Panel | None:
    """One line a job."""
    lines = [
        Line(job.name, [frame.time_s for frame in job.frames], energies, color=index)
        for index, (job, energies) in enumerate((job, job.total_energy()) for job in jobs)
        if any(map(math.isfinite, energies))
    ]
    return Panel(TOTAL_ENERGY, "J", tuple(lines)) if lines else None


def _is_seen(values: Sequence[float]) -> bool:
    """Whether a line is more than zero."""
    return any(math.isfinite(value) and value != 0.0 for value in values)


def _value(frame: FrameNumbers, solver: str, name: str) -> float:
    numbers = frame.solvers.get(solver, {})
    return (with_energy(numbers) if name == MECHANICAL_ENERGY else numbers).get(name, math.nan)
