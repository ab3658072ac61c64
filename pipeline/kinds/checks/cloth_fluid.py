"""Checks of cloth and fluid: the fluid's weight on a cloth, and its buoyancy."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.fluid import openings_of
from pipeline.model.boxes import Box
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import ClothParameters
from sim.fluid.opening import Opening
from sim.fluid.traits import TRAITS


def fluid_over(job: Job, solids: Solids, box: Box) -> float:
    """Mass of the fluid that falls onto a cloth's box within the film [kg], if nothing stops it and none runs off.

    Blocks by the share of their box that is above the cloth's, jets by where their middle gets to its height; above is
    along the axis that gravity is most nearly along.
    """
    gravity = np.asarray(job.gravity, dtype=np.float64)
    if not gravity.any():
        return 0.0
    down = int(np.abs(gravity).argmax())
    sides = [axis for axis in range(3) if axis != down]
    mass = 0.0
    for index, fluid in enumerate(job.fluid):
        volume = 0.0
        for path, solid in solids.items():
            if path[:2] == ("fluid", index):
                low, high = solid.bounds
                is_above = (box.mean(axis=0) - solid.bounds.mean(axis=0))[down] * gravity[down] > 0.0
                shared = np.clip(np.minimum(high, box[1]) - np.maximum(low, box[0]), 0.0, None)[sides]
                volume += is_above * solid.volume * float(np.prod(shared / (high - low)[sides]))
        for _, opening in openings_of(job, index):
            if _falls_onto(opening, box, gravity, down):
                volume += opening.particles_due(job.film_s) * fluid.lattice_volume
        mass += fluid.rest_density * min(volume, fluid.most_volume)
    return mass


def _falls_onto(opening: Opening, box: Box, gravity: NDArray[np.float64], down: int) -> bool:
    """Whether the middle of a jet comes down to the middle of a box within its sides."""
    sign, (centre, velocity) = float(np.sign(gravity[down])), opening.first_jet
    drop = sign * float(box[:, down].mean() - centre[down])
    speed, pull = sign * float(velocity[down]), abs(float(gravity[down]))
    if drop <= 0.0:
        return False
    time = 2.0 * drop / (speed + math.sqrt(speed**2 + 2.0 * pull * drop))
    point = centre + time * velocity + 0.5 * time**2 * gravity
    within = (point >= box[0]) & (point <= box[1])
    within[down] = True
    return bool(within.all())


def check_buoyancy(job: Job, path: KeyPath, cloth: ClothParameters, findings: Findings) -> None:
    """Warn of loose cloth that weighs so nearly what it displaces that whether it sinks is not known."""
    if any(pin.release_s is None for pin in cloth.pin) or not any(job.gravity):
        return
    for fluid in job.fluid:
        displaced = fluid.rest_density * cloth.thickness
        least = TRAITS[fluid.solver].buoyancy_error * fluid.rest_density * fluid.spacing
        if abs(cloth.mass_per_area - displaced) < least:
            findings.warn(
                (*path, "mass_per_area"),
                f'{cloth.mass_per_area:g} kg/m², and the "{fluid.name}" that its thickness displaces '
                f"{displaced:.3g} kg/m²: with particles of this size they must differ by {least:.2g} kg/m² for it to "
                "sink or float by its weight; below the surface it goes where the fluid takes it",
            )
            return
