"""A drop hits a spinning box, without gravity or walls: together they keep their linear and angular momentum."""

from __future__ import annotations

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.fluids import EVERY_FACE, FLUID_SOLVERS, WATER, WEIGHTLESS, state_of
from benchmarks.validation.rigid_bodies import body
from benchmarks.validation.tanks import SPACING, Tank
from sim.domain import DomainParameters

SOLVERS = FLUID_SOLVERS
DENSITIES, QUICK_DENSITIES = (100.0, 500.0, 2000.0), (500.0,)
"""Of the box [kg/m³]."""

DURATION, QUICK_DURATION = 0.2, 0.1
"""How long it is followed [s]: the drop is there after a tenth of it, and has splashed at its end."""

LOW, HIGH = (-0.2, -0.06, -0.06), (-0.08, 0.06, 0.06)
SPEED = 2.0
"""Corners of the drop [m], and its speed along x [m/s]."""

BOX, AT = (0.1, 0.14, 0.08), (0.0, 0.05, 0.0)
SPIN = (3.0, 0.0, 5.0)
"""Edges of the box [m], where it is [m] - off the line of the drop -, and its angular velocity [rad/s]."""

SPACE = DomainParameters(min=(-1.0,) * 3, max=(1.0,) * 3, open_faces=EVERY_FACE)


def run(solver: str, *, quick: bool = False) -> CaseResult:
    """The collision with boxes that are lighter and heavier than the drop, with friction between both."""
    densities = QUICK_DENSITIES if quick else DENSITIES
    checks: list[Check] = []
    series: dict[str, list[float]] = {}
    for density in densities:
        tank = _collision(solver, density)
        count = tank.fluid.particle_count
        start = _totals(tank)
        scales = float(np.linalg.norm(start[0])), float(np.linalg.norm(start[0]) * HIGH[1] + np.linalg.norm(start[1]))
        drifts: dict[str, list[float]] = {"times": [], "linear": [], "angular": []}
        for time in tank.advance(QUICK_DURATION if quick else DURATION, cuts=20):
            linear, angular = (
                float(np.abs(now - before).max()) / scale
                for now, before, scale in zip(_totals(tank), start, scales, strict=True)
            )
            for name, value in zip(drifts, (time, linear, angular), strict=True):
                drifts[name].append(value)
        given = float(tank.rigid.bodies.mass[0] * tank.rigid.bodies.velocity[0, 0] / start[0][0])
        # Stuck together, box and drop would share the momentum by their masses.
        share = float(tank.rigid.bodies.mass[0] / (tank.rigid.bodies.mass[0] + _mass(tank)))
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
    settings = {
        "particles": count,
        "densities": list(densities),
        "speed_m_per_s": SPEED,
        "spin_rad_per_s": SPIN,
        "box_m": BOX,
    }
    return CaseResult("coupled-momentum", solver, settings, checks, series)


def _collision(solver: str, density: float) -> Tank:
    box = body("box", {"type": "box", "size": BOX}, density=density, position=AT, angular_velocity=SPIN)
    return Tank(
        solver, [box], domain=SPACE, depth=0.0, spacing=SPACING, gravity=WEIGHTLESS, block=(LOW, HIGH),
        velocity=(SPEED, 0.0, 0.0), wall_friction=5.0, viscosity=1.0e-3,
    )  # fmt: skip


def _totals(tank: Tank) -> tuple[np.ndarray, np.ndarray]:
    """Linear [kg m/s] and angular momentum about the origin [kg m²/s] of water and box."""
    position, velocity = state_of(tank.fluid)
    mass = WATER * tank.fluid.particle_volume
    box = tank.rigid.diagnostics()
    linear = np.array([box[f"momentum_{axis}"] for axis in "xyz"])
    angular = np.array([box[f"angular_momentum_{axis}"] for axis in "xyz"])
    return mass * velocity.sum(axis=0) + linear, mass * np.cross(position, velocity).sum(axis=0) + angular


def _mass(tank: Tank) -> float:
    """Of the water [kg]."""
    return WATER * tank.fluid.particle_volume * tank.fluid.particle_count
