"""A ball of water that falls onto a fixed bunny: how much of its mechanical energy each solver keeps."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from matplotlib.figure import Figure

from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import COLOURS, label_axes, make_panels, style_of

BALL_RADIUS, BALL_HEIGHT, BUNNY_HEIGHT = 0.25, 0.95, 0.5  # of the water and its centre; the bunny [m]

DURATION = 1.0
FRAMES_PER_SECOND = 60.0
IMPACT_FRAME = 10  # the last frame before the water touches the bunny, 0.2 m below it: 0.2 s after the start

ARTIFICIAL_VISCOSITY, EQUAL_VISCOSITY = 0.05, 0.005
"""The default, and with which WCSPH is as viscous as the others: it multiplies the speed of sound there, and a tenth of
it, the largest expected speed, in the implicit solvers."""


def scene(solver: str, spacing: float, artificial_viscosity: float = ARTIFICIAL_VISCOSITY) -> SceneParameters:
    """The bunny in the middle of a walled square metre, the ball above it."""
    bunny = {"type": "bunny", "height": BUNNY_HEIGHT}
    water = {
        "name": "water",
        "solver": solver,
        "particle_radius": spacing / 2.0,
        "artificial_viscosity": artificial_viscosity,
        "block": [{"shape": {"type": "sphere", "radius": BALL_RADIUS}, "position": (0, 0, BALL_HEIGHT)}],
    }
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.5), "open_faces": ()},
            "rigid": [{"name": "bunny", "shape": bunny, "position": (0.0, 0.0, BUNNY_HEIGHT / 2.0)}],
            "fluid": [water],
        }
    )


def find(solver: str, spacing: float, compared: Sequence[str]) -> Found:
    """Energies frame by frame, at a spacing [m], also of the compared solvers with the viscosity of the others."""
    states = _fall(scene(solver, spacing))
    total = [_mechanical(state) for state in states]
    kept = [energy / total[0] for energy in total]
    rise = max(after - before for before, after in pairwise(kept))
    checks = [
        Check("energy kept until the impact", kept[IMPACT_FRAME], 1.0, 1e-2,
              "free fall loses none, but symplectic Euler lags by g t dt/2: 0.5 % at a step of 6 ms"),
        Check("largest rise of the energy in a frame, over that of the start", max(rise, 0.0), 0.0, 5e-3,
              "nothing may add energy; pressure waves of the impact store and give back some that is not counted"),
        Check("energy kept after 1 s", kept[-1], 0.25, 0.15,
              "no theory: 0.04 is what water at rest on the floor has, the rest moves"),
        Check("particles lost", states[0]["particle_count"] - states[-1]["particle_count"], 0.0, 0.0, "a count"),
    ]  # fmt: skip
    series: dict[str, Any] = {
        "times": [frame / FRAMES_PER_SECOND for frame in range(len(states))],
        "kept": kept,
        "kinetic": [state["kinetic_energy"] / total[0] for state in states],
    }
    if solver in compared:
        others = [_mechanical(state) for state in _fall(scene(solver, spacing, EQUAL_VISCOSITY))]
        series["kept_with_equal_viscosity"] = [energy / others[0] for energy in others]
    return checks, series


def _fall(parameters: SceneParameters) -> list[Any]:
    """The water's diagnostics at the start and after every frame."""
    from sim.build import build_world

    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    states: list[Any] = [world.diagnostics()["water"]]
    for _ in range(round(DURATION * FRAMES_PER_SECOND)):
        states.append(world.advance_frame().diagnostics["water"])
    return states


def _mechanical(state: Any) -> float:
    """Kinetic, potential and, where the fluid is compressible, elastic energy [J]."""
    return float(state["kinetic_energy"] + state["potential_energy"] + state.get("elastic_energy", 0.0))


def draw(results: Sequence[CaseResult]) -> Figure:
    """Mechanical and kinetic energy over time."""
    figure, (total, kinetic) = make_panels(2, width=4.2, height=3.0)
    for result in results:
        series, style, times = result.series, style_of(result), result.series["times"]
        total.plot(times, series["kept"], **style)
        if "kept_with_equal_viscosity" in series:
            alike = {"color": COLOURS[result.solver], "label": "WCSPH, viscosity of the others"}
            total.plot(times, series["kept_with_equal_viscosity"], ":", **alike)
        kinetic.plot(times, series["kinetic"], **style)
    for axes in (total, kinetic):
        axes.set_ylim(bottom=0.0)
    label_axes(total, "time [s]", "energy / that of the start", "mechanical energy")
    label_axes(kinetic, "time [s]", "kinetic energy / energy of the start", "kinetic energy")
    return figure


CASE = Case(find, draw, sizes={"spacing": (0.016, 0.04), "compared": (("wcsph",), ())})
