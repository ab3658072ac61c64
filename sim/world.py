"""The world: every solver of a scene, advanced frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.snapshots import Snapshot
from sim.solver import Arrays, Coupling, Diagnostics, SimulationDivergedError, Solver

if TYPE_CHECKING:
    from sim.rigid.static import StaticBody

MAX_SUBSTEPS_PER_FRAME = 200_000
"""More than this in one frame is a step size that collapses, not a simulation (1/60 s / 2e5 is 83 ns)."""

SUBSTEPS_BETWEEN_CHECKS = 64
"""How often the state is looked over within a frame: often enough to stop early, too rarely to cost anything."""


@dataclass(frozen=True)
class FrameReport:
    """What computing one frame took.

    Attributes:
        frame: number of the frame just reached.
        time_s: simulated time [s].
        substeps: number of substeps of this frame, by solver.
        smallest_dt_s: smallest substep of this frame [s], by solver.
        diagnostics: physics and numerics after the frame, by solver.
    """

    frame: int
    time_s: float
    substeps: Mapping[str, int]
    smallest_dt_s: Mapping[str, float]
    diagnostics: Mapping[str, Diagnostics]


class World:
    """Owns the loop over substeps; solvers own their arrays.

    Solvers that a coupling connects share their substeps; the others advance at their own step. A substep takes the
    solvers in the order given: a coupling exchanges impulses right before its second solver's turn, and tells the first
    what became of the second when all have had theirs. Every group lands
    exactly on the frame: with dt_max stable, the rest of the frame is cut into n = ceil(rest / dt_max) equal steps,
    one is taken, and the division is made anew for what is left.
    """

    def __init__(
        self,
        solvers: Sequence[Solver],
        *,
        frames_per_second: float,
        couplings: Sequence[Coupling] = (),
        static_bodies: Sequence[StaticBody] = (),
    ) -> None:
        self.frame = 0
        self._frames_per_second = frames_per_second
        self._solvers = {solver.name: solver for solver in solvers}
        self._couplings = tuple(couplings)
        self._static_bodies = tuple(static_bodies)
        order = list(self._solvers)
        for first, second in (coupling.bodies for coupling in self._couplings):
            if order.index(first) >= order.index(second):
                raise ValueError(f'"{first}" must stand before "{second}", which it is coupled to, among the solvers')
        self._groups = _coupled_groups(self._solvers, self._couplings)

    @property
    def time_s(self) -> float:
        """Simulated time [s]; frame k is at k / fps, never a sum of steps."""
        return self.frame / self._frames_per_second

    def advance_frame(self) -> FrameReport:
        """Advance to the next frame.

        Raises:
            SimulationDivergedError: the state became non-finite or ran away, or the step size collapsed.
        """
        substeps: dict[str, int] = {}
        smallest_dt: dict[str, float] = {}
        for solver in self._solvers.values():
            solver.begin_frame(self.time_s)
        for group, couplings in self._groups:
            count, dt = self._advance_group(group, couplings)
            substeps |= dict.fromkeys((solver.name for solver in group), count)
            smallest_dt |= dict.fromkeys((solver.name for solver in group), dt)
        self.frame += 1
        return FrameReport(self.frame, self.time_s, substeps, smallest_dt, self.diagnostics())

    def diagnostics(self) -> dict[str, Diagnostics]:
        """Physics and numerics of the frame just computed, by solver."""
        return {name: solver.diagnostics() for name, solver in self._solvers.items()}

    def snapshots(self) -> dict[str, Snapshot]:
        """What rendering needs, by body."""
        snapshots = {body.name: body.snapshot() for body in self._static_bodies}
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
        for coupling in self._couplings:
            coupling.resume()
        self.frame = frame

    def _advance_group(self, group: Sequence[Solver], couplings: Sequence[Coupling]) -> tuple[int, float]:
        remaining = 1.0 / self._frames_per_second
        taken, smallest_dt = 0, math.inf
        while remaining > 0.0:
            stable_dt = min(solver.stable_dt() for solver in group)
            left = self._steps_left(remaining, stable_dt, taken, group)
            dt = remaining / left
            for solver in group:
                for coupling in couplings:
                    if coupling.bodies[1] == solver.name:
                        coupling.exchange(dt)
                solver.substep(dt)
            for coupling in couplings:
                coupling.follow(dt)
            remaining = remaining - dt if left > 1 else 0.0
            taken += 1
            smallest_dt = min(smallest_dt, dt)
            if taken % SUBSTEPS_BETWEEN_CHECKS == 0 or remaining == 0.0:
                self._check(group, 1.0 / self._frames_per_second - remaining)
        return taken, smallest_dt

    def _steps_left(self, remaining: float, stable_dt: float, taken: int, group: Sequence[Solver]) -> int:
        if not stable_dt > 0.0 or taken + remaining / stable_dt > MAX_SUBSTEPS_PER_FRAME:
            self._check(group, 1.0 / self._frames_per_second - remaining)
            raise SimulationDivergedError(
                " + ".join(solver.name for solver in group),
                self.frame + 1,
                self.time_s + 1.0 / self._frames_per_second - remaining,
                f"the stable time step fell to {stable_dt:.3g} s",
                "lower initial speeds, or give a larger particle radius or cell size",
            )
        return max(1, math.ceil(remaining / stable_dt * (1.0 - 1.0e-9)))

    def _check(self, group: Sequence[Solver], elapsed_s: float) -> None:
        for solver in group:
            quantity = solver.first_bad_quantity()
            if quantity is not None:
                raise SimulationDivergedError(
                    solver.name,
                    self.frame + 1,
                    self.time_s + elapsed_s,
                    quantity,
                    'use dt = "adaptive", or a smaller dt or cfl',
                )


def _coupled_groups(
    solvers: Mapping[str, Solver], couplings: Sequence[Coupling]
) -> list[tuple[list[Solver], list[Coupling]]]:
    """Connected components of the solvers under the couplings, in the order of the solvers."""
    component = {name: name for name in solvers}
    for coupling in couplings:
        kept, merged = (component[body] for body in coupling.bodies)
        component = {name: kept if label == merged else label for name, label in component.items()}
    return [
        (
            [solver for name, solver in solvers.items() if component[name] == label],
            [coupling for coupling in couplings if component[coupling.bodies[0]] == label],
        )
        for label in dict.fromkeys(component.values())
    ]
