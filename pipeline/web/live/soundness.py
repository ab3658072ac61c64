"""Signs of a blow-up, and the checkpoints that a scene goes back to after one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.live_parameters import Value
from sim.core.solver import SimulationDivergedError
from sim.core.world import FrameReport, World

FASTEST = 200.0
"""A scene in which anything moves faster [m/s] has blown up: nothing of a tabletop does, and a jet has half of it."""
LONGEST_FRAME_S = 5.0
"""A frame that takes longer counts as blown up [s]."""
LONGEST_SUBSTEP_S = 0.5
"""A substep counts for no more: kernels compile, and machines sleep, within a few of them, and that passes."""
FRAMES_BETWEEN = 30
"""Frames from one checkpoint to the next."""
FRAMES_TO_TRUST = 60
"""A checkpoint that is younger than this at a blow-up may carry its cause."""


def require_sound(report: FrameReport) -> None:
    """Blow-ups show as speeds long before they show as values that are no numbers.

    Raises SimulationDivergedError: something is absurdly fast.
    """
    for name, numbers in report.diagnostics.items():
        speed = float(numbers.get("max_speed", 0.0))
        if not speed <= FASTEST:
            raise SimulationDivergedError(name, report.frame, report.time_s, f"something moves at {speed:.3g} m/s")


class FrameTimer:
    """A timer that looks at the clock [s] after every substep of a frame: a page answers between frames only.

    A frame may take `longest_s` at the longest; infinite where people asked for slow frames.
    """

    def __init__(self, longest_s: float, *, clock: Callable[[], float]) -> None:
        self.longest_s, self._clock = longest_s, clock
        self.begin_frame()

    def begin_frame(self) -> None:
        """A frame begins now."""
        self._spent_s, self._seen_s = 0.0, self._clock()

    @property
    def is_too_slow(self) -> bool:
        """Whether the frame has taken too long."""
        return self._spent_s > self.longest_s

    def after_substep(self) -> str | None:
        """Fault of the frame, if it has taken too long."""
        now = self._clock()
        self._spent_s += min(now - self._seen_s, LONGEST_SUBSTEP_S)
        self._seen_s = now
        return f"a frame takes longer than {self.longest_s:g} s" if self.is_too_slow else None


@dataclass(frozen=True)
class Checkpoint:
    """A state of a scene: its frame, the arrays of its world, the paths of its bodies, and the live parameters."""

    frame: int
    arrays: Mapping[str, NDArray[np.generic]]
    paths: Mapping[int, Any]
    values: Mapping[str, Value]

    @classmethod
    def of(cls, world: World, values: Mapping[str, Value]) -> Checkpoint:
        """The state of a world now."""
        solvers: Mapping[str, Any] = world.solvers
        paths = dict(solvers["rigid"].paths) if "rigid" in solvers else {}
        return cls(world.frame, world.checkpoint(), paths, dict(values))

    def restore(self, world: World) -> None:
        """Put another world of the same job into this state."""
        solvers: Mapping[str, Any] = world.solvers
        if "rigid" in solvers:
            solvers["rigid"].paths.update(self.paths)
        world.restore(self.frame, dict(self.arrays))


class Checkpoints(deque[Checkpoint]):
    """The last checkpoints."""

    def __init__(self) -> None:
        super().__init__(maxlen=3)

    def trusted(self, frame: int) -> Checkpoint | None:
        """The newest that does not carry the cause of a blow-up at a frame; None if there is none."""
        return next((each for each in reversed(self) if frame - each.frame >= FRAMES_TO_TRUST), None)
