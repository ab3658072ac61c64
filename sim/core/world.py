"""The world: every solver of a scene, advanced frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Coupling, Diagnostics, SimulationDivergedError, Solver

MAX_SUBSTEPS_PER_FRAME = 200_000  # more than this is a step size that collapses (1/60 s / 2e5 is 83 ns)
SUBSTEPS_BETWEEN_CHECKS = 64  # of the state within a frame: often enough to stop early


@dataclass(frozen=True)
class FrameReport:
    """What computing one frame took."""

    frame: int  # number of the frame just reached
    time_s: float  # simulated time [s]
    substeps: Mapping[str, int]  # number of substeps of this frame, by solver
    smallest_dt_s: Mapping[str, float]  # smallest substep of this frame [s], by solver
    diagnostics: Mapping[str, Diagnostics]  # physics and numerics after the frame, by solver


class World:
    """The loop over substeps.

    Solvers that a coupling connects share their substeps; the others advance at their own step. A substep takes the
    solvers in the order given: a coupling exchanges impulses right before its second solver's turn, and tells the first
    what became of the second when all have had theirs. The second solver of a loose coupling keeps its own steps: the
    solvers that it is coupled to first go to the end of its step, in as many substeps as they need.

    All land exactly on the frame: the rest of it is cut into n = ceil(rest / dt_stable) equal steps, one is taken, and
    the division is made anew for what is left; in the same way substeps land on a longer step.

    Attributes:
        frame: number of the frame that was reached last.
        max_substeps_per_frame: a frame that needs more counts as diverged; may be changed between frames.
        watch: asked after every substep what is wrong with the frame, which counts as diverged then; may be None.
            What it raises leaves the frame half done: only `restore` goes on from there.
        before_substep: called with a solver's name and the length [s] of its substep right before that, as an external
            force is; may be None.

    Args:
        at_moment: called with the simulated time [s] at which each substep starts, right before it: what acts in all
            solvers alike goes to that moment.
    """

    def __init__(
        self,
        solvers: Sequence[Solver],
        *,
        frames_per_second: float,
        couplings: Sequence[Coupling] = (),
        standing: Mapping[str, Snapshot] | None = None,
        at_moment: Callable[[float], None] | None = None,
    ) -> None:
        self.frame = 0
        self.max_substeps_per_frame = MAX_SUBSTEPS_PER_FRAME
        self.watch: Callable[[], str | None] | None = None
        self.before_substep: Callable[[str, float], None] | None = None
        self._at_moment = at_moment
        self._frames_per_second = frames_per_second
        self._solvers = {solver.name: solver for solver in solvers}
        self._couplings = tuple(couplings)
        self._standing = dict(standing or {})  # what never moves: the same at every frame
        order = list(self._solvers)
        for first, second in (coupling.bodies for coupling in self._couplings):
            if order.index(first) >= order.index(second):
                raise ValueError(f'"{first}" must stand before "{second}", which it is coupled to, among the solvers')
        self._teams = _teams(self._solvers, self._couplings)

    @property
    def time_s(self) -> float:
        """Simulated time [s]; frame k is at k / fps, never a sum of steps."""
        return self.frame / self._frames_per_second

    @property
    def solvers(self) -> Mapping[str, Solver]:
        """All solvers by name; what they let change may be changed between frames."""
        return MappingProxyType(self._solvers)

    def tell_couplings(self) -> None:
        """Tell the couplings what was changed between frames: how bodies move now, and how easily."""
        for coupling in self._couplings:
            coupling.resume()

    def advance_frame(self) -> FrameReport:
        """Advance to the next frame, and look at it.

        Raises SimulationDivergedError: as `go_to_next_frame`.
        """
        substeps, smallest_dt = self.go_to_next_frame()
        return FrameReport(self.frame, self.time_s, substeps, smallest_dt, self.diagnostics())

    def go_to_next_frame(self) -> tuple[dict[str, int], dict[str, float]]:
        """Advance to the next frame; returns the substeps that it took and the smallest of them [s], by solver.

        Raises:
            SimulationDivergedError: the state became non-finite or ran away, the step size collapsed, or `watch` found
                something.
        """
        substeps: dict[str, int] = {}
        smallest_dt: dict[str, float] = {}
        for solver in self._solvers.values():
            solver.begin_frame(self.time_s)
        for last in self._teams:
            teams = [team for team in (last.ahead, last) if team is not None]
            for team in teams:
                team.begin_frame()
            self._advance_team(last, 1.0 / self._frames_per_second, 0.0)
            for team in teams:
                substeps |= dict.fromkeys((solver.name for solver in team.solvers), team.taken)
                smallest_dt |= dict.fromkeys((solver.name for solver in team.solvers), team.smallest_dt_s)
        self.frame += 1
        return substeps, smallest_dt

    def diagnostics(self) -> dict[str, Diagnostics]:
        """Physics and numerics of the frame just computed, by solver."""
        return {name: solver.diagnostics() for name, solver in self._solvers.items()}

    def snapshots(self) -> dict[str, Snapshot]:
        """What rendering needs, by body."""
        snapshots = dict(self._standing)
        for solver in self._solvers.values():
            snapshots |= solver.snapshots()
        return snapshots

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """All that `restore` needs to continue bit for bit; keys are `<solver>/<array>`."""
        return {
            f"{name}/{key}": array
            for name, solver in self._solvers.items()
            for key, array in solver.checkpoint().items()
        }

    def restore(self, frame: int, arrays: Arrays) -> None:
        """Continue from a checkpoint taken at `frame`. Raises ValueError when it does not fit the scene."""
        for name, solver in self._solvers.items():
            prefix = f"{name}/"
            own = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
            if not own:
                raise ValueError(f'the checkpoint holds nothing for "{name}"')
            solver.restore(own)
        self.tell_couplings()
        self.frame = frame

    def _advance_team(self, team: _Team, duration_s: float, start_s: float) -> None:
        """Advance a team by a duration [s] from a moment of the frame [s] on."""
        remaining = duration_s
        while remaining > 0.0:
            elapsed_s = start_s + (duration_s - remaining)
            left = self._steps_left(team, remaining, elapsed_s)
            dt = remaining / left
            if team.ahead is not None:
                self._advance_team(team.ahead, dt, elapsed_s)
            if self._at_moment is not None:
                self._at_moment(self.time_s + elapsed_s)
            team.substep(dt, self.before_substep)
            if team.ahead is not None:
                team.ahead.tell_of(team.pushed)
            remaining = remaining - dt if left > 1 else 0.0
            if (finding := self.watch and self.watch()) is not None:
                raise self._divergence(team.names, start_s + (duration_s - remaining), finding)
            if team.taken % SUBSTEPS_BETWEEN_CHECKS == 0 or remaining == 0.0:
                self._check(team, start_s + (duration_s - remaining))

    def _steps_left(self, team: _Team, remaining: float, elapsed_s: float) -> int:
        stable_dt, shortest = min(((solver.stable_dt(), solver) for solver in team.solvers), key=itemgetter(0))
        if not stable_dt > 0.0 or team.taken + remaining / stable_dt > self.max_substeps_per_frame:
            self._check(team, elapsed_s)
            finding = f"the stable time step fell to {stable_dt:.3g} s"
            raise self._divergence(team.names, elapsed_s, finding, shortest.remedies().short_steps)
        return max(1, math.ceil(remaining / stable_dt * (1.0 - 1.0e-9)))

    def _check(self, team: _Team, elapsed_s: float) -> None:
        for solver in team.solvers:
            quantity = solver.first_bad_quantity()
            if quantity is not None:
                raise self._divergence(solver.name, elapsed_s, quantity, solver.remedies().runaway)

    def _divergence(self, names: str, elapsed_s: float, finding: str, hint: str = "") -> SimulationDivergedError:
        return SimulationDivergedError(names, self.frame + 1, self.time_s + elapsed_s, finding, hint)


class _Team:
    """Solvers that take the same substeps in turn, and the couplings whose second solver is one of them.

    Those ahead have to get to the end of a step before these take it.
    """

    def __init__(self, solvers: Sequence[Solver], couplings: Sequence[Coupling], ahead: _Team | None = None) -> None:
        self.solvers, self.ahead = tuple(solvers), ahead
        self.names = " + ".join(solver.name for solver in solvers)
        names = {solver.name for solver in solvers}
        self.couplings = tuple(coupling for coupling in couplings if coupling.bodies[1] in names)
        self.pushed = {coupling.bodies[0] for coupling in self.couplings if coupling.pushes_first}
        self.begin_frame()

    def begin_frame(self) -> None:
        self.taken, self.smallest_dt_s = 0, math.inf  # substeps in this frame, and the smallest of them [s]

    def tell_of(self, pushed: Collection[str]) -> None:
        """Tell the couplings how those of some solvers move that others have pushed since."""
        for coupling in self.couplings:
            if coupling.bodies[1] in pushed:
                coupling.follow(0.0)

    def substep(self, dt: float, before: Callable[[str, float], None] | None) -> None:
        for solver in self.solvers:
            for coupling in self.couplings:
                if coupling.bodies[1] == solver.name:
                    coupling.exchange(dt)
            if before is not None:
                before(solver.name, dt)
            solver.substep(dt)
        for coupling in self.couplings:
            coupling.follow(dt)
        self.taken += 1
        self.smallest_dt_s = min(self.smallest_dt_s, dt)


def _teams(solvers: Mapping[str, Solver], couplings: Sequence[Coupling]) -> list[_Team]:
    """A team for each connected component of the solvers under the couplings, in the order of the solvers.

    Those of a component that a loose coupling leads to follow the others at their own steps.

    Raises:
        ValueError: such a solver is coupled to another one in a way that needs shared substeps.
    """
    component = {name: name for name in solvers}
    for coupling in couplings:
        kept, merged = (component[body] for body in coupling.bodies)
        component = {name: kept if label == merged else label for name, label in component.items()}
    late = {coupling.bodies[1] for coupling in couplings if coupling.is_loose}
    for coupling in couplings:
        for body in coupling.bodies[: 1 if coupling.is_loose else 2]:
            if body in late:
                first, second = coupling.bodies
                raise ValueError(f'"{body}" has steps of its own and cannot share those of "{first}" and "{second}"')
    teams = []
    for label in dict.fromkeys(component.values()):
        own = [solver for name, solver in solvers.items() if component[name] == label]
        punctual = [solver for solver in own if solver.name not in late]
        team = _Team(punctual, couplings)
        following = [solver for solver in own if solver.name in late]
        teams.append(_Team(following, couplings, ahead=team) if following else team)
    return teams
