"""The whitewater of one fluid at one moment."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class WhitewaterKind(IntEnum):
    """What a particle is, by how much fluid is around it."""

    SPRAY = 0
    FOAM = 1
    BUBBLE = 2


@dataclass(frozen=True)
class WhitewaterCloud:
    """All particles, in the order in which they were made: all that the next frame needs to know."""

    position: NDArray[np.float32]  # [m], (n, 3), float32
    velocity: NDArray[np.float32]  # [m/s], (n, 3), float32
    radius: NDArray[np.float32]  # drawn radius [m], (n,), float32
    lifetime: NDArray[np.float32]  # what is left of it as foam [s], (n,), float32
    kind: NDArray[np.uint8]  # values of `WhitewaterKind`, (n,), uint8

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def empty(cls) -> WhitewaterCloud:
        """No particles."""
        vectors, numbers = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        return cls(vectors, vectors, numbers, numbers, np.zeros(0, np.uint8))

    def kept(self, rows: NDArray[np.bool_]) -> WhitewaterCloud:
        """The particles of a mask (n,)."""
        return WhitewaterCloud(*(getattr(self, each.name)[rows] for each in fields(self)))

    def joined(self, other: WhitewaterCloud) -> WhitewaterCloud:
        """These particles, then those."""
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return WhitewaterCloud(*(np.concatenate(pair) for pair in pairs))
