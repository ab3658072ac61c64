"""What a solver and a coupling are to the world that drives them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sim.core.snapshots import Snapshot

Arrays = Mapping[str, NDArray[np.generic]]
Diagnostics = Mapping[str, float]
"""Numbers about one body at one moment, SI units, by name; a count is a float too.

Common names: `mass`, `momentum_x|y|z`, `kinetic_energy`, `potential_energy`, `particle_count`, `particles_removed`,
`iterations`, `residual`, `max_speed`, `not_converged` (how many solves of this frame hit their limit).
"""


class SimulationDivergedError(RuntimeError):
    """The state stopped being physical.

    Attributes:
        body: name of the body.
        frame: the frame being computed.
        time_s: simulated time [s].
        quantity: the first bad quantity, with its value.
    """

    def __init__(self, body: str, frame: int, time_s: float, quantity: str, hint: str = "") -> None:
        super().__init__(body, frame, time_s, quantity, hint)
        self.body, self.frame, self.time_s, self.quantity, self.hint = body, frame, time_s, quantity, hint

    @property
    def finding(self) -> str:
        """What happened, without what a job may do about it."""
        return f'"{self.body}" diverged at frame {self.frame}, t = {self.time_s:.4f} s: {self.quantity}'

    def __str__(self) -> str:
        return f"{self.finding}; {self.hint}" if self.hint else self.finding


class OutgrownError(RuntimeError):
    """There is no memory for what a body grows to; its state is still that of the last frame."""


@dataclass(frozen=True, slots=True)
class Remedies:
    """What a job may change where a solver fails: its own keys, in words."""

    runaway: str  # against a state that is not finite any more, or beyond all reason
    short_steps: str  # against stable steps that get too short


class Solver(Protocol):
    """One family of bodies that steps together. Owns its arrays; knows no file and no other solver."""

    name: str

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state."""

    def remedies(self) -> Remedies:
        """What may help where it fails, with its parameters of the moment."""

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""

    def snapshots(self) -> dict[str, Snapshot]:
        """What rendering needs, by body name; arrays that no later substep changes, as they are written meanwhile."""

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """All that `restore` needs to continue bit for bit; arrays that no later substep changes."""

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint of the same parameters. Raises ValueError when it does not fit."""

    def diagnostics(self) -> Diagnostics:
        """Physics and numerics of the frame just computed; per-frame counters restart with `begin_frame`."""

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at simulated time `time_s`: reset the counters of the frame."""

    def first_bad_quantity(self) -> str | None:
        """The first non-finite or runaway quantity of the state, in words, or None."""


@runtime_checkable
class HasViews(Protocol):
    """A solver whose state others may look at between substeps."""

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:
        """Arrays of a body now, good until the next substep: the solver's own memory on a CPU, where that has them."""


@runtime_checkable
class TakesPushes(HasViews, Protocol):
    """A solver whose bodies others may push between substeps."""

    def push(self, body: str, change: NDArray[np.floating]) -> None:
        """Change the velocity of what is free to move, in the order of `view`, by (n, 3) or (3,) [m/s]."""


@runtime_checkable
class Grows(Protocol):
    """A solver that takes more memory as its bodies grow.

    Attributes:
        refusal: why there is no memory for so many more elements, in words, or None; asked before there are more, and
            where it refuses `OutgrownError` is raised. None: nobody is asked.
    """

    refusal: Callable[[float], str | None] | None


class Coupling(Protocol):
    """Exchanges momentum between two solvers; one that works one way only has nothing to do in `follow` and `resume`.

    Attributes:
        bodies: names of the two; the first takes its substep before the second.
        is_loose: whether the second keeps its own steps, over each of which the first takes as many as it needs; they
            share their substeps otherwise.
        pushes_first: whether `follow` changes how the first moves; couplings of others with it are told again then.
    """

    bodies: tuple[str, str]
    is_loose = False
    pushes_first = False

    @abstractmethod
    def exchange(self, dt: float) -> None:
        """Right before the second's step of dt [s], which the first has made: hand the impulses of the first to it."""

    def follow(self, dt: float) -> None:
        """After both have made a step of dt [s]: tell the first where the second is now; 0 if it only was pushed."""

    def resume(self) -> None:
        """After both were restored from a checkpoint: make up for what the solvers do not save."""
