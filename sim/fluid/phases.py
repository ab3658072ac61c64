"""The fluids that share a tank: one set of particles, one time step, a material for each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, on_device
from sim.core.bundles import bundle
from sim.fluid.parameters import FluidParameters


@bundle
class Materials(NamedTuple):
    """Materials by number, (k,) each."""

    rest_density: Floats  # rho0 [kg/m³]
    dynamic_viscosity: Floats  # mu = rho0 nu [Pa s]
    surface_tension: Floats  # coefficient, in the unit of its model
    several: ti.template()  # whether there is more than one


class Phases:
    """Materials by number, one of which each particle has as its `phase`.

    Attributes:
        parameters: of each fluid.
        names: of each fluid.
        rest_densities: rho0 of each [kg/m³], (k,), float64, on the host.
        viscosities: nu of each [m²/s], (k,), float64, on the host.
        materials: of all of them on the device, float32.
    """

    def __init__(self, parameters: Sequence[FluidParameters]) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(fluid.name for fluid in parameters)
        self.rest_densities = np.array([fluid.rest_density for fluid in parameters])
        self.viscosities = np.array([fluid.viscosity for fluid in parameters])
        self.materials = Materials(
            rest_density=on_device(self.rest_densities),
            dynamic_viscosity=on_device(self.rest_densities * self.viscosities),
            surface_tension=on_device(np.array([fluid.surface_tension for fluid in parameters])),
            several=len(self.parameters) > 1,
        )

    def set_viscosities(self, viscosities: NDArray[np.float64]) -> None:
        """Change nu of each fluid [m²/s], (k,), in the arrays that solvers hold."""
        self.viscosities[:] = viscosities
        self.materials.dynamic_viscosity.from_numpy((self.rest_densities * viscosities).astype(np.float32))

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def shared(self) -> FluidParameters:
        """The first fluid, for what all fluids of a tank have in common: solver, particle radius, time step."""
        return self.parameters[0]

    @property
    def density_contrast(self) -> float:
        """Largest rest density over the smallest."""
        return float(self.rest_densities.max() / self.rest_densities.min())
