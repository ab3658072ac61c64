"""The box of the domain as particles meet it."""

from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.bundles import bundle
from sim.core.domain import DomainParameters

UNLIMITED = 1.0e30  # coordinate that no particle reaches [m]


@bundle
class Box(NamedTuple):
    """The box that holds the particles: closed faces stop them, open faces let them go."""

    wall_low: ti.math.vec3  # corners of the closed faces [m]; out of reach where a face is open
    wall_high: ti.math.vec3
    keep_low: ti.math.vec3  # corners of the open faces [m]; out of reach where a face is closed
    keep_high: ti.math.vec3


def box_of(domain: DomainParameters) -> Box:
    """The box of a domain."""
    is_open = np.array([[f"{axis}{side}" in domain.open_faces for axis in "xyz"] for side in "-+"])
    ends = np.array([domain.min, domain.max])
    far = np.array([[-UNLIMITED], [UNLIMITED]])
    return Box(*map(tuple, [*np.where(is_open, far, ends).tolist(), *np.where(is_open, ends, far).tolist()]))
