"""Checkpoints of a running scene, which a blow-up goes back to."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.web.live.parameters import Value

if TYPE_CHECKING:
    from sim.core.world import World

FRAMES_BETWEEN = 30
"""Frames from one checkpoint to the next."""
FRAMES_TO_TRUST = 60
"""A checkpoint that is younger than this at a blow-up may carry its cause."""


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
