"""The fluids that share a tank: one set of particles, one time step, a material for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.fluid.parameters import FluidParameters


class Phases:
    """Materials by number; the particles' `phase` says which of them each one is of.

    Attributes:
        parameters: of each fluid.
        names: of each fluid.
        rest_densities: rho0 of each [kg/m³], (k,), float64, on the host.
        viscosities: nu of each [m²/s], (k,), float64, on the host.
        rest_density: the same on the device, float32.
        dynamic_viscosity: mu = rho0 nu of each [Pa s], on the device.
        surface_tension: coefficient of each, in the unit of its model, on the device.
    """

    def __init__(self, parameters: Sequence[FluidParameters]) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(fluid.name for fluid in parameters)
        self.rest_densities = np.array([fluid.rest_density for fluid in parameters])
        self.viscosities = np.array([fluid.viscosity for fluid in parameters])
        self.rest_density = device_table(self.rest_densities)
        self.dynamic_viscosity = device_table(self.rest_densities * self.viscosities)
        self.surface_tension = device_table(np.array([fluid.surface_tension for fluid in parameters]))

    def set_viscosities(self, viscosities: NDArray[np.float64]) -> None:
        """Change nu of each fluid [m²/s], (k,), in the arrays that solvers hold."""
        self.viscosities[:] = viscosities
        self.dynamic_viscosity.from_numpy((self.rest_densities * viscosities).astype(np.float32))

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


def device_table(values: np.ndarray) -> ti.Ndarray:
    """A number for each fluid, float32, on the device."""
    array = ti.ndarray(ti.f32, len(values))
    array.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
    return array
