"""Arrays of a smoke as kernels take them: flat, with a layer of ghosts around the cells (`SmokeGrid`)."""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import bundle


@bundle
class Faces(NamedTuple):
    """A value for each face, by the axis that the faces lie across."""

    x: Floats
    y: Floats
    z: Floats


@bundle
class State(NamedTuple):
    """What a smoke is at one time."""

    velocity: Faces  # [m/s]
    density: Floats  # [-]
    excess: Floats  # temperature over the air's [K]


def new_floats(size: int) -> ti.Ndarray:
    """An array of zeros."""
    return ti.ndarray(ti.f32, size)


def new_faces(size: int) -> Faces:
    """Zeros for the faces of a grid of so many values an array."""
    return Faces(new_floats(size), new_floats(size), new_floats(size))


def new_state(size: int) -> State:
    """Air at rest without smoke."""
    return State(new_faces(size), new_floats(size), new_floats(size))
