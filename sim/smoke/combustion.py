"""Burning of fuel that smoke carries: heat, soot and expansion (Feldman, O'Brien & Arikan 2003; Nguyen et al. 2002).

Where it is hotter than the ignition temperature, fuel Y [-], a part of the gas, burns at a rate r [1/s]:

    dY/dt = -r,   DT/Dt = H r,   drho/dt = s r,   div u = (DT/Dt) / T

with the heat H [K], the soot s [-] and the expansion of an ideal gas of constant pressure. In a step the burnt fuel is
b = min(Y, r dt), the gas heats up by H b exactly, and its volume grows by the logarithm of its temperatures' ratio.
Mixing with the air and radiation (`sim.smoke.forces.cool`) let flames die; gas that cools does not shrink.

Temperature and fuel belong to the gas, whatever room it takes: what expands keeps them (`sim.smoke.transport`). Smoke
is counted by volume, and becomes thinner.
"""

import taichi as ti

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.smoke.arrays import new_floats
from sim.smoke.lanes import lane_items, lane_place, row_start
from sim.smoke.obstacles import Air, mean_volume, part_before
from sim.smoke.parameters import FireParameters
from sim.smoke.reductions import Pair, Rows, partial_place, sum_up


class Combustion:
    """The fuel of one grid, and what becomes of it.

    Attributes:
        fuel: part of the gas of each cell [-], flat.
        expansion: divergence that burning asks for in the present step, times the edge of a cell [m/s], flat.
        parameters: of the fire.
    """

    def __init__(self, parameters: FireParameters, size: int, *, ambient_temperature: float, cell_size: float) -> None:
        """Have room for so many values; nothing burns yet."""
        self.parameters, self._ambient, self._cell_size = parameters, ambient_temperature, cell_size
        self.fuel, self.expansion = new_floats(size), new_floats(size)

    def burn(self, air: Air, dt: float, rows: Rows) -> tuple[float, float]:
        """Burn for dt [s]; returns the burnt fuel, and by how much the gas expands, in sums over the air of cells."""
        fire = self.parameters
        given = self._ambient, fire.ignition_temperature, fire.burn_rate * dt, fire.heat, fire.soot
        burnt, grown = _burn(
            air, self.fuel, self.expansion, rows, *given, fire.expansion * self._cell_size / dt, dt / self._cell_size
        )
        return burnt, grown


@kernel
def _burn(
    air: Air,
    fuel: Floats,
    expansion: Floats,
    rows: Rows,
    ambient: ti.f32,
    ignition: ti.f32,
    most: ti.f32,
    heat: ti.f32,
    soot: ti.f32,
    rate: ti.f32,
    step: ti.f32,
) -> Pair:
    box, solids, state = ti.static((air.box, air.solids, air.state))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        burnt, grown = 0.0, 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            before = ambient + state.excess[at]
            part = ti.select(before >= ignition, ti.min(fuel[at], most), 0.0)
            fuel[at] -= part
            state.excess[at] += heat * part
            state.density[at] += soot * part
            expansion[at] = rate * ti.log(1.0 + heat * part / before)
            burnt += part_before(solids, at) * part
            grown += mean_volume(solids, at) * step * expansion[at]
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([burnt, grown])
    sum_up(rows)
    return rows.nodes[0]
