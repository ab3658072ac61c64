"""What time alone does to smoke: it thins out, and cools by Newton's law and by radiation."""

import math

import taichi as ti

from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.parameters import SmokeParameters


@ti.data_oriented
class Cooling:
    """Density rho and excess e of the temperature over the air's, each solved exactly over a step.

    d rho/dt = -d rho with the dissipation d; de/dt = -c e - k (max(e, 0)/e_max)⁴ with the cooling c, the radiative
    cooling k and the excess e_max of the hottest source (Nguyen, Fedkiw & Jensen 2002).

    Args:
        grid: the cells.
        parameters: the rates.
        density: [-], flat field.
        excess_temperature: [K], flat field.
    """

    def __init__(
        self, grid: SmokeGrid, parameters: SmokeParameters, *, density: ti.Field, excess_temperature: ti.Field
    ) -> None:
        self._parameters = parameters
        self._density, self._excess_temperature = density, excess_temperature
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._lanes = lane_count()

    def advance(self, dt: float) -> None:
        """Let dt [s] pass."""
        self._cool(
            math.exp(-self._parameters.density_dissipation * dt),
            math.exp(-self._parameters.cooling * dt),
            self._radiated(dt),
        )

    def _radiated(self, dt: float) -> float:
        """The factor r [1/K³], by which e' = e exp(-c dt) (1 + r e³)^(-1/3) solves both laws exactly.

        The law of e is linear in e^-3: r = k (1 - exp(-3 c dt)) / (c e_max⁴).
        """
        hottest = self._parameters.hottest_excess
        if self._parameters.radiative_cooling == 0.0 or hottest == 0.0:
            return 0.0
        rate = 3.0 * self._parameters.cooling
        time = -math.expm1(-rate * dt) / rate if rate > 0.0 else dt
        return 3.0 * self._parameters.radiative_cooling * time / hottest**4

    @ti.kernel
    def _cool(self, density_factor: ti.f32, excess_factor: ti.f32, radiated: ti.f32):
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz, lane)):
                k = lane_place(n, lane)
                self._density[row + k] *= density_factor
                excess = self._excess_temperature[row + k]
                if ti.static(self._parameters.radiative_cooling > 0.0):
                    heat = ti.max(excess, 0.0)
                    excess *= (1.0 + radiated * heat * heat * heat) ** (-1.0 / 3.0)
                self._excess_temperature[row + k] = excess * excess_factor
