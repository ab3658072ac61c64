"""Bodies as they are drawn: arrays in world axes, one class for each form (`pipeline.kinds.base.Display`)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Particles:
    """Points, such as particles of a fluid or its whitewater."""

    kind: str
    position: Floats  # [m], (n, 3)
    values: Mapping[str, Floats]  # quantities that they can be coloured by, (n,) each, by name
    radius: float  # of a particle [m]
    rest_density: float | None  # of the fluid [kg/m³]; None of whitewater
    count: int  # number of particles, of which n are shown


@dataclass(frozen=True)
class Sheet:
    """A mesh, such as a cloth: positions of its nodes [m], (n, 3), and its triangles, (k, 3) int32."""

    kind: str
    position: Floats
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class Pose:
    """Place of a rigid body: position [m], (3,), and orientation, a unit quaternion w, x, y, z, (4,)."""

    kind: str
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]


@dataclass(frozen=True)
class Smoke:
    """The cells of a grid that are not empty, such as those of a smoke."""

    kind: str
    density: Floats  # (nx, ny, nz) [-]
    origin: tuple[float, float, float]  # lower corner of the first cell [m]
    cell_size: float  # [m]


Body = Particles | Sheet | Pose | Smoke


def arrays_of(body: object) -> Iterator[NDArray[Any]]:
    """All arrays that a body, or a mesh, keeps in memory."""
    for value in vars(body).values():
        if isinstance(value, np.ndarray):
            yield value
        elif isinstance(value, Mapping):
            yield from value.values()
