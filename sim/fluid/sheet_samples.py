"""Samples of thin sheets that a fluid feels, as a part of its boundary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import (
    SUPPORT_IN_SPACINGS,
    evaluate,
    lattice_offsets,
    layer_field,
    particle_volume,
    wall_calibration,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

AMID_SAMPLES = 2.5
"""Relative density of a particle in the middle of a sheet by the sheet's samples alone: so far above 1 that none gets
through, and no more than that, so that fluid at rest comes near."""


@dataclass(frozen=True, eq=False)
class SheetSamples:
    """One layer of samples of each sheet."""

    boundary: BoundarySamples  # samples of the sheets at rest, with volumes that let nothing through, (m, 3)
    own_mass: NDArray[np.float64]  # of the sheet's part that each stands for [kg], (m,)
    # of fluid that keeps its distance on both sides of that part without being displaced [m³], (m,)
    missing_volume: NDArray[np.float64]


def sheet_factor(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Factor on the volumes of a sheet's samples [-], relative to those of a wall."""
    wall = wall_calibration(support_in_spacings)
    amid = wall.volume_in_particles * layer_field(0.0, support_in_spacings)
    return AMID_SAMPLES / (amid * particle_volume(1.0, support_in_spacings))


def resting_field(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Density that samples give to the first layer of a fluid at rest beside them [-]: what it lacks of 1."""
    offsets = lattice_offsets(support_in_spacings)
    beyond = np.linalg.norm(offsets[offsets[:, 2] > 0.0], axis=1)
    return particle_volume(1.0, support_in_spacings) * float(evaluate(beyond, support_in_spacings).sum())


def sheet_standoff(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Distance from a sheet at which a lattice of fluid is at rest [spacings]: 1.3 at the usual support."""
    wall = wall_calibration(support_in_spacings)
    volume = sheet_factor(support_in_spacings) * wall.volume_in_particles * particle_volume(1.0, support_in_spacings)
    lacking = resting_field(support_in_spacings)
    return float(brentq(lambda gap: volume * layer_field(gap, support_in_spacings) - lacking, 0.0, support_in_spacings))


def kept_away(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Distance from a sheet within which there is no fluid [spacings]: particles fill half a spacing around them."""
    return sheet_standoff(support_in_spacings) - 0.5


def one_sided_field(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """V sum_i W_ib over the particles of a lattice at rest on one side of a sheet [-]."""
    gaps = np.arange(sheet_standoff(support_in_spacings), support_in_spacings)
    layers = sum(layer_field(float(gap), support_in_spacings) for gap in gaps)
    return particle_volume(1.0, support_in_spacings) * layers


def one_sided_tilt(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Length of the mean unit vector from a sheet to the particles of a lattice at rest on one side, weighted by W."""
    axis = np.arange(-np.ceil(support_in_spacings), np.ceil(support_in_spacings) + 1)
    gaps = np.arange(sheet_standoff(support_in_spacings), support_in_spacings)
    # As a sample lies anywhere between the particles, and no less often in the middle of four than on one.
    offsets = np.stack(np.meshgrid(axis + 0.25, axis + 0.25, gaps, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.linalg.norm(offsets, axis=1)
    weights = evaluate(distances, support_in_spacings)
    return float((weights * offsets[:, 2] / distances).sum() / weights.sum())
