"""What time alone does to smoke: it thins out, and cools by Newton's law and by radiation."""

import math

import taichi as ti

from sim.core.launch import kernel
from sim.smoke.lanes import lane_items, lane_place, row_start
from sim.smoke.obstacles import Air
from sim.smoke.parameters import SmokeParameters


def cool(air: Air, parameters: SmokeParameters, dt: float) -> None:
    """Let dt [s] pass for density rho and excess e of the temperature, each solved exactly over a step.

    d rho/dt = -d rho with the dissipation d; de/dt = -c e - k (max(e, 0)/e_max)⁴ with the cooling c, the radiative
    cooling k and the excess e_max of the hottest source (Nguyen, Fedkiw & Jensen 2002).
    """
    density_factor = math.exp(-parameters.density_dissipation * dt)
    excess_factor = math.exp(-parameters.cooling * dt)
    radiates = parameters.radiative_cooling > 0.0
    _cool(air, density_factor, excess_factor, radiated(parameters, dt), radiates)


def radiated(parameters: SmokeParameters, dt: float) -> float:
    """The factor r [1/K³], by which e' = e exp(-c dt) (1 + r e³)^(-1/3) solves both laws exactly.

    The law of e is linear in e^-3: r = k (1 - exp(-3 c dt)) / (c e_max⁴).
    """
    hottest = parameters.hottest_excess
    if parameters.radiative_cooling == 0.0 or hottest == 0.0:
        return 0.0
    rate = 3.0 * parameters.cooling
    time = -math.expm1(-rate * dt) / rate if rate > 0.0 else dt
    return 3.0 * parameters.radiative_cooling * time / hottest**4


@kernel
def _cool(air: Air, density_factor: ti.f32, excess_factor: ti.f32, radiated: ti.f32, radiates: ti.template()):
    box, state = ti.static((air.box, air.state))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            state.density[at] *= density_factor
            excess = state.excess[at]
            if ti.static(radiates):
                heat = ti.max(excess, 0.0)
                excess *= (1.0 + radiated * heat * heat * heat) ** (-1.0 / 3.0)
            state.excess[at] = excess * excess_factor
