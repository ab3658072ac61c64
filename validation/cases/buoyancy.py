"""Bodies in water that nothing holds: neutral ones stay where they are, light ones float at their draught."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import COLOURS, THEORY, label_axes, make_panels, style_of
from validation.scenes import SPACING, WATER, Tank, body, recorded, submerged_sphere

NEUTRAL_RADIUS = 3 * SPACING  # of the neutral sphere [m]
DUCK_TANK = (1.6, 1.4, 1.6)  # length, width and depth of its water over its length
BOX = (0.16, 0.16, 0.12)  # edges of what floats [m]; it is lower than wide, so that it floats upright


def find(solver: str, shapes: Sequence[str], duck_length: float, densities: Sequence[float], duration: float) -> Found:
    """A neutral sphere and duck, whose bill and tail are thinner than two spacings, and boxes of densities [kg/m³]."""
    tanks = {
        "sphere": lambda: submerged_sphere(solver, WATER, NEUTRAL_RADIUS),
        "duck": lambda: _submerged_duck(solver, duck_length),
    }
    neutral = {name: _neutral(tanks[name](), duration) for name in shapes}
    afloat = {density: _afloat(solver, density, duration) for density in densities}
    checks = [
        *(
            Check(f"largest displacement of a neutral {name} in {duration:g} s", each["displacement"], 0.0,
                  SPACING * math.sqrt(0.5 * duration),
                  "the required one spacing in 2 s; less as the root of the time, as particles push it at random", "m")
            for name, each in neutral.items()
        ),
        *(
            Check(f"draught of a box of {density:g} kg/m³", each["draught"], each["exact"], SPACING,
                  "the required one spacing", "m")
            for density, each in afloat.items()
        ),
        Check("particles in a body or out of the tank",
              float(sum(each["astray"] for each in (*neutral.values(), *afloat.values()))), 0.0, 0.0, "a count"),
    ]  # fmt: skip
    series: dict[str, Any] = {}
    for name, each in neutral.items():
        series |= {f"displacements_{name}": each["displacements"], "neutral_times": each["times"]}
    for density, each in afloat.items():
        series |= {f"afloat_{density:g}": each["draughts"], "afloat_times": each["times"]}
    return checks, series


def _submerged_duck(solver: str, length: float) -> Tank:
    """A duck of the water's density amid water, which fills the tank around it as a job fills its blocks."""
    sides = [round(share * length / SPACING) * SPACING for share in DUCK_TANK]
    duck = body("duck", {"type": "duck", "length": length}, density=WATER, position=(0.0, 0.0, sides[2] / 2.0))
    domain = DomainParameters(
        min=(-sides[0] / 2.0, -sides[1] / 2.0, 0.0), max=(sides[0] / 2.0, sides[1] / 2.0, 1.4 * sides[2])
    )
    return Tank(solver, [duck], domain=domain, depth=sides[2])


def _neutral(tank: Tank, duration: float) -> dict[str, Any]:
    start = tank.rigid.bodies.position[0].copy()
    found: dict[str, Any] = recorded(
        tank,
        duration,
        cuts=round(50 * duration),
        start=True,
        displacements=lambda: np.linalg.norm(tank.rigid.bodies.position[0] - start),
    )
    return {**found, "displacement": max(found["displacements"]), "astray": tank.astray()}


def _afloat(solver: str, density: float, duration: float) -> dict[str, Any]:
    """A box set on the water at its draught: how deep its lower face lies under the mean surface, later on."""
    exact = density / WATER * BOX[2]
    low = 0.2
    side = 0.36
    # The water rises by what the box displaces.
    surface = low + exact * BOX[0] * BOX[1] / side**2
    box = body(
        "box", {"type": "box", "size": BOX}, density=density, position=(0.0, 0.0, surface - exact + BOX[2] / 2.0)
    )
    domain = DomainParameters(min=(-side / 2.0, -side / 2.0, 0.0), max=(side / 2.0, side / 2.0, 0.6))
    tank = Tank(solver, [box], domain=domain, depth=round(surface / SPACING) * SPACING)
    volume, area = tank.fluid.particle_count * tank.fluid.particle_volume, BOX[0] * BOX[1]

    def draught() -> float:
        """The surface lies where water and the part of the box below it fill the tank: H A = V + (H - bottom) a."""
        bottom = float(tank.rigid.bodies.position[0, 2]) - BOX[2] / 2.0
        return (volume - bottom * area) / (side**2 - area) - bottom

    found: dict[str, Any] = recorded(tank, duration, cuts=round(25 * duration), draughts=draught)
    settled = [each for time, each in zip(found["times"], found["draughts"], strict=True) if time > 0.5 * duration]
    return {**found, "draught": float(np.mean(settled)), "exact": exact, "astray": tank.astray()}


def draw(results: Sequence[CaseResult]) -> Figure:
    """Way of neutral bodies, draught of boxes."""
    figure, (neutral, afloat) = make_panels(2, width=4.2)
    densities = results[0].settings["densities"]
    for result in results:
        series, colour = result.series, COLOURS[result.solver]
        for name, dash in (("sphere", "-"), ("duck", "--")):
            neutral.plot(
                series["neutral_times"], [1e3 * each for each in series[f"displacements_{name}"]], dash, color=colour
            )
        neutral.plot([], [], **style_of(result))
        for density, dash in zip(densities, ("-", "--", ":"), strict=False):
            draughts = [1e3 * draught for draught in series[f"afloat_{density:g}"]]
            afloat.plot(series["afloat_times"], draughts, dash, color=colour, linewidth=1.0)
    neutral.axhline(1e3 * SPACING, color=THEORY, linewidth=1.0, label="one spacing")
    label_axes(neutral, "time [s]", "displacement [mm]", "neutral sphere (solid) and duck (dashed)")
    for density in densities:
        afloat.axhline(1e3 * density / WATER * BOX[2], color=THEORY, linewidth=1.0)
    title = f"floating box, {', '.join(f'{density:g}' for density in densities)} kg/m³"
    label_axes(afloat, "time [s]", "draught [mm]; black: theory", title, legend=False)
    return figure


SIZES = {
    "shapes": (("sphere", "duck"), ("duck",)),  # of the neutral bodies
    "duck_length": (14 * SPACING, 10 * SPACING),
    "densities": ((300.0, 500.0, 800.0), (300.0, 800.0)),  # of the boxes
    "duration": (2.0, 0.5),
}
CASE = Case(find, draw, sizes=SIZES)
