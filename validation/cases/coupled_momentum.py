"""A drop hits a spinning box, without gravity or walls: together they keep their linear and angular momentum."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.cases.free_momentum import draw_drifts
from validation.checks import CaseResult, Check
from validation.scenes import EVERY_FACE, WATER, WEIGHTLESS, Curve, Tank, body, momentum_drifts, momentum_of

LOW, HIGH = (-0.2, -0.06, -0.06), (-0.08, 0.06, 0.06)
SPEED = 2.0  # corners of the drop [m], and its speed along x [m/s]

BOX, AT = (0.1, 0.14, 0.08), (0.0, 0.05, 0.0)
SPIN = (3.0, 0.0, 5.0)
"""Edges of the box [m], where it is [m] - off the line of the drop -, and its angular velocity [rad/s]."""

SPACE = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)


def find(solver: str, densities: Sequence[float], duration: float) -> Found:
    """The collision with boxes that are lighter and heavier than the drop [kg/m³], with friction between both."""
    checks: list[Check] = []
    series: dict[str, Any] = {}
    for density in densities:
        box = body("box", {"type": "box", "size": BOX}, density=density, position=AT, angular_velocity=SPIN)
        drop = {"block": (LOW, HIGH), "velocity": (SPEED, 0.0, 0.0)}
        tank = Tank(solver, [box], domain=SPACE, gravity=WEIGHTLESS, **drop, wall_friction=5.0, viscosity=1.0e-3)
        count, bodies = tank.fluid.particle_count, tank.rigid.bodies
        linear, angular = _totals(tank)
        scales = float(np.linalg.norm(linear)), float(np.linalg.norm(linear) * HIGH[1] + np.linalg.norm(angular))
        drifts = momentum_drifts(tank, lambda tank=tank: _totals(tank), scales, duration, cuts=20)
        given = float(bodies.mass[0] * bodies.velocity[0, 0] / linear[0])
        # Stuck together, box and drop would share the momentum by their masses.
        water = WATER * tank.fluid.particle_volume * tank.fluid.particle_count
        share = float(bodies.mass[0] / (bodies.mass[0] + water))
        checks += [
            Check(f"drift of linear momentum, box of {density:g} kg/m³", max(drifts["linear"]), 0.0, 1e-5,
                  "the required bound, over that of the drop; pair forces cancel but for float32 rounding"),
            Check(f"drift of angular momentum, box of {density:g} kg/m³", max(drifts["angular"]), 0.0, 1e-5,
                  "the required bound; pair forces are central, and torques are taken about the box's own centre"),
            Check(f"momentum that a box of {density:g} kg/m³ got, over that of sticking together", given / share, 1.0,
                  0.7, "that there was an impact: most of the water runs past the box, none bounces back like a ball"),
            Check("particles lost", float(count - tank.fluid.particle_count), 0.0, 0.0, "a count"),
        ]  # fmt: skip
        series |= {"times": drifts["times"]}
        series |= {f"{name}_{density:g}": drifts[name] for name in ("linear", "angular")}
    return checks, series


def _totals(tank: Tank) -> tuple[Curve, Curve]:
    """Momenta of water and box."""
    linear, angular = momentum_of(tank.fluid, WATER * tank.fluid.particle_volume)
    box = tank.rigid.diagnostics()
    return (
        linear + np.array([box[f"momentum_{axis}"] for axis in "xyz"]),
        angular + np.array([box[f"angular_momentum_{axis}"] for axis in "xyz"]),
    )


def draw(results: Sequence[CaseResult]) -> Figure:
    """Drift over time, of the collision with the lightest box."""
    lightest = min(results[0].settings["densities"])
    return draw_drifts(results, {name: f"{name}_{lightest:g}" for name in ("linear", "angular")})


# The drop is there after a tenth of the time, and has splashed at its end.
CASE = Case(find, draw, sizes={"densities": ((100.0, 500.0, 2000.0), (500.0,)), "duration": (0.2, 0.1)})
