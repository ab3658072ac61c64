"""A body in water: held, released, neutral, afloat."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.fluids import FLUID_SOLVERS, GRAVITY, WATER, state_of
from benchmarks.validation.rigid_bodies import body
from benchmarks.validation.tanks import Tank
from sim.scene import DomainParameters

SOLVERS = FLUID_SOLVERS
SPACING = 0.02
RADII_IN_SPACINGS, QUICK_RADIUS_IN_SPACINGS = (3, 4, 5), 3
"""Of the sphere."""

SIDE_IN_RADII = 6.0
"""Of the tank with the sphere, and the depth of its water."""

SETTLING, MEASURED = 0.6, 0.6
"""Time for which bodies are held until the water has come to rest, and over which the force is averaged [s]."""

RELEASE, FITTED = 0.02, (0.002, 0.012)
"""How long a released sphere is followed, and the span in which its acceleration is taken [s].

Sound has to go round the sphere first; later, friction at its surface is as large as its added mass.
"""

SWAY = 0.12
"""Of the force on a held sphere about its mean, over rho g V: sloshing and sound in a small tank."""

RELEASED_DENSITIES = (500.0, 2000.0)
FLOATING_DENSITIES = (300.0, 500.0, 800.0)
QUICK_FLOATING_DENSITIES = (500.0,)
BOX = (0.16, 0.16, 0.12)
"""Edges of what floats [m]; it is lower than wide, so that it floats upright."""


def run(solver: str, *, quick: bool = False) -> CaseResult:
    """The four bodies."""
    sizes = (QUICK_RADIUS_IN_SPACINGS,) if quick else RADII_IN_SPACINGS
    held = {size: _held(solver, size * SPACING) for size in sizes}
    radius = sizes[-1] * SPACING
    released = {density: _released(solver, density, radius) for density in RELEASED_DENSITIES}
    neutral = _neutral(solver, QUICK_RADIUS_IN_SPACINGS * SPACING)
    densities = QUICK_FLOATING_DENSITIES if quick else FLOATING_DENSITIES
    afloat = {density: _afloat(solver, density) for density in densities}
    checks = [
        *(
            Check(f"force on a held sphere of radius {size} d over rho g V", each["force"], 1.0, 0.1 / size,
                  "a thirtieth of a spacing in the radius of what it displaces")
            for size, each in held.items()
        ),
        Check("sideways force on it over rho g V", held[sizes[-1]]["sideways"], 0.0, 0.02, "symmetry; mean of 0.6 s"),
        *(
            Check(f"first acceleration of a sphere of {density:g} kg/m³ over theory", each["ratio"], 1.0,
                  WATER / abs(density - WATER) * (SWAY + 0.1 / sizes[-1]),
                  "the force on a held sphere sways by 12 % of rho g V about its mean, itself as uncertain as above, "
                  "which counts rho_f/(rho_s - rho_f) times in the acceleration")
            for density, each in released.items()
        ),
        # A tenth at five spacings, where it is kept; of first order in d/R, as everything at a sphere's surface.
        Check("added mass over that of the displaced water", _added_mass(released), 0.53, 0.5 / sizes[-1],
              "0.5 in water without end, 0.56 inside of a shell of three radii; from both densities, so that what the "
              "water does at the moment of the release cancels"),
        Check("farthest way of a neutral sphere in 2 s", neutral["way"], 0.0, SPACING, "the required one spacing", "m"),
        *(
            Check(f"draught of a box of {density:g} kg/m³", each["draught"], each["exact"], SPACING,
                  "the required one spacing", "m")
            for density, each in afloat.items()
        ),
        Check("particles in a body or out of the tank",
              float(sum(each["astray"] for each in (*held.values(), neutral, *afloat.values()))), 0.0, 0.0, "a count"),
    ]  # fmt: skip
    series: dict[str, Any] = {"sizes": list(sizes), "held": [each["force"] for each in held.values()]}
    series |= {"held_times": held[sizes[-1]]["times"], "held_forces": held[sizes[-1]]["forces"]}
    series |= {"neutral_times": neutral["times"], "neutral_ways": neutral["ways"]}
    for density, each in released.items():
        series |= {f"released_{density:g}": each["speeds"], "released_times": each["times"]}
    for density, each in afloat.items():
        series |= {f"afloat_{density:g}": each["draughts"], "afloat_times": each["times"]}
    settings = {
        "spacing_m": SPACING,
        "radii_in_spacings": list(sizes),
        "side_in_radii": SIDE_IN_RADII,
        "box_m": BOX,
        "released_densities": list(released),
        "floating_densities": list(afloat),
    }
    return CaseResult("buoyancy", solver, settings, checks, series)


def _tank(solver: str, density: float | None, radius: float) -> Tank:
    """A sphere in the middle of the water; held for good where it has no density."""
    side = SIDE_IN_RADII * radius
    kind = {"kind": "kinematic"} if density is None else {"density": density}
    sphere = body("sphere", {"type": "sphere", "radius": radius}, position=(0.0, 0.0, side / 2.0), **kind)
    domain = DomainParameters(min=(-side / 2.0, -side / 2.0, 0.0), max=(side / 2.0, side / 2.0, 1.4 * side))
    return Tank(solver, [sphere], domain=domain, depth=side, spacing=SPACING)


def _held(solver: str, radius: float) -> dict[str, Any]:
    tank = _tank(solver, None, radius)
    weight = WATER * GRAVITY * 4.0 / 3.0 * np.pi * radius**3
    times, forces = [], []
    for time in tank.advance(SETTLING + MEASURED, cuts=300):
        times.append(time)
        forces.append(tank.coupling.force[0] / weight)
    settled = np.mean([force for time, force in zip(times, forces, strict=True) if time > SETTLING], axis=0)
    return {
        "times": times,
        "forces": [float(force[2]) for force in forces],
        "force": float(settled[2]),
        "sideways": float(np.linalg.norm(settled[:2])),
        "astray": _astray(tank),
    }


def _released(solver: str, density: float, radius: float) -> dict[str, Any]:
    """Acceleration over g (rho_s - rho_f) / (rho_s + rho_f / 2), positive along that."""
    tank = _tank(solver, density, radius)
    tank.settle(SETTLING)
    times, speeds = [0.0], [0.0]
    for time in tank.advance(RELEASE, cuts=40):
        times.append(time)
        speeds.append(float(tank.rigid.bodies.velocity[0, 2]))
    exact = -GRAVITY * (density - WATER) / (density + WATER / 2.0)
    fitted = (np.array(times) >= FITTED[0]) & (np.array(times) <= FITTED[1])
    slope = float(np.polyfit(np.array(times)[fitted], np.array(speeds)[fitted], 1)[0])
    return {"times": times, "speeds": [speed / exact for speed in speeds], "ratio": slope / exact}


def _added_mass(released: dict[float, dict[str, Any]]) -> float:
    """C in (rho_s - b rho_f) g = (rho_s + C rho_f) a, with the same b and C for both densities."""
    # Two linear equations: b rho_f g + C rho_f a = rho_s (g - a), a downwards.
    rows, sides = [], []
    for density, each in released.items():
        acceleration = each["ratio"] * GRAVITY * (density - WATER) / (density + WATER / 2.0)
        rows.append([GRAVITY * WATER, acceleration * WATER])
        sides.append(density * (GRAVITY - acceleration))
    return float(np.linalg.solve(np.array(rows), np.array(sides))[1])


def _neutral(solver: str, radius: float) -> dict[str, Any]:
    tank = _tank(solver, WATER, radius)
    start = tank.rigid.bodies.position[0].copy()
    times, ways = [0.0], [0.0]
    for time in tank.advance(2.0, cuts=100):
        times.append(time)
        ways.append(float(np.linalg.norm(tank.rigid.bodies.position[0] - start)))
    return {"times": times, "ways": ways, "way": max(ways), "astray": _astray(tank)}


def _afloat(solver: str, density: float) -> dict[str, Any]:
    """A box set on the water at its draught: how deep its lower face lies under the mean surface after 2 s."""
    exact = density / WATER * BOX[2]
    low = 0.2
    side = 0.36
    # The water rises by what the box displaces.
    surface = low + exact * BOX[0] * BOX[1] / side**2
    box = body(
        "box", {"type": "box", "size": BOX}, density=density, position=(0.0, 0.0, surface - exact + BOX[2] / 2.0)
    )
    domain = DomainParameters(min=(-side / 2.0, -side / 2.0, 0.0), max=(side / 2.0, side / 2.0, 0.6))
    tank = Tank(solver, [box], domain=domain, depth=round(surface / SPACING) * SPACING, spacing=SPACING)
    volume = tank.fluid.particle_count * tank.fluid.particle_volume
    times, draughts = [], []
    for time in tank.advance(2.0, cuts=50):
        bottom = float(tank.rigid.bodies.position[0, 2]) - BOX[2] / 2.0
        # The surface lies where water and the part of the box below it fill the tank: H A = V + (H - bottom) a.
        area = BOX[0] * BOX[1]
        level = (volume - bottom * area) / (side**2 - area)
        times.append(time)
        draughts.append(level - bottom)
    settled = [draught for time, draught in zip(times, draughts, strict=True) if time > 1.0]
    return {
        "times": times,
        "draughts": draughts,
        "draught": float(np.mean(settled)),
        "exact": exact,
        "astray": _astray(tank),
    }


def _astray(tank: Tank) -> int:
    """Particles with their centre inside of a body by more than a tenth of a spacing, and those that left."""
    position, _ = state_of(tank.fluid)
    inside = 0
    for number, turned in enumerate(tank.rigid.bodies.rotation()):
        in_body = (position - tank.rigid.bodies.position[number]) @ turned
        distance = tank.rigid.signed_distance_in_body_frame(number)(in_body)
        inside += int((distance < -0.1 * SPACING).sum())
    return inside + tank.fluid.particles_removed
