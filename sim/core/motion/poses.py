"""Poses of many bodies at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Where all bodies are: the moving ones, the static ones, and last the domain, which walls belong to."""

    position: Array  # centres of mass [m], (n, 3)
    rotation: Array  # body axes to world axes, (n, 3, 3)
