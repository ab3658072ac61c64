"""A pyramid of boxes that a ball hits: it stands until then, falls, and comes to rest."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import SHADES, label_axes, make_panels
from validation.scenes import body, make_bodies, steps

EDGE, GAP, FRICTION = 0.1, 0.001, 0.5  # of the boxes; between those of a layer [m]; [-]
RADIUS, DENSITY, SPEED = 0.15, 3000.0, 6.0  # of the ball [m], [kg/m³], [m/s]
FAR_WALL = 12.0  # where the ball does not come with boxes before it, to press them against it [m]
AWAY = 0.45  # of the ball's centre from the lowest layer [m]
FRAMES_PER_SECOND = 60
MOVED = 0.05  # half an edge: a box that got so far no longer lies as it did [m]
STANDING_FRAMES, AWAKE_FRAMES = 3, 3  # before the blow, and after the rest, when all boxes are woken
THOUSANDTH = "a thousandth of an edge"


def find(_: str, layers: int, most_frames: int) -> Found:
    """Kinetic energy, who sleeps and the deepest overlap, frame by frame, until all boxes sleep.

    The ball is no part of that: nothing brakes what rolls.
    """
    solver, boxes = _scene(layers)
    start = solver.bodies.position.copy()
    blow = 0.5 * float(solver.bodies.mass[-1]) * SPEED**2
    series: dict[str, list[float]] = {name: [] for name in ("times", "kinetic", "total", "asleep", "depth_mm")}
    stood, not_converged, rested_s = 0.0, 0, float("inf")
    for frame in range(1, most_frames + 1):
        numbers = _frame(solver, frame)
        moved = np.linalg.norm(solver.bodies.position - start, axis=1)[boxes]
        if frame == STANDING_FRAMES:
            stood = float(moved.max())
        asleep = int(np.count_nonzero(solver.bodies.is_asleep[boxes]))
        not_converged += int(numbers["not_converged"])
        series["times"].append(frame / FRAMES_PER_SECOND)
        series["kinetic"].append(_kinetic_energy(solver.bodies, boxes))
        series["total"].append(numbers["kinetic_energy"] + numbers["potential_energy"])
        series["asleep"].append(asleep / len(start[boxes]))
        series["depth_mm"].append(1e3 * numbers["max_penetration"])
        if asleep == len(start[boxes]):
            rested_s = frame / FRAMES_PER_SECOND
            break
    fell = float(np.count_nonzero(moved > MOVED)) / len(moved)
    lay = solver.bodies.position.copy()
    solver.bodies.wake(np.ones(len(lay), dtype=bool))
    depth, speed = 0.0, 0.0
    for _ in range(AWAKE_FRAMES):
        frame += 1
        depth = max(depth, _frame(solver, frame)["max_penetration"])
        speed = max(speed, float(np.sqrt(np.square(solver.bodies.velocity[boxes]).sum(axis=1).mean())))
    rises = np.diff(series.pop("total"))
    checks = [
        Check("largest way of a box before the blow", stood, 0.0, 1e-4, THOUSANDTH, "m"),
        Check("share of the boxes that the blow moved by half an edge or more", fell, 1.0, 0.9,
              "it falls: a tenth of them at least"),
        Check("share of the boxes that sleep in the end", series["asleep"][-1], 1.0, 0.0, "it comes to rest"),
        Check("when they do", rested_s, 0.0, most_frames / FRAMES_PER_SECOND, "within what is computed", "s"),
        Check("deepest overlap in the blow", 1e-3 * max(series["depth_mm"]), 0.0, 2e-3,
              "a fiftieth of an edge: twice what contacts are not looked for again for", "m"),
        Check("largest gain of energy in a frame over the ball's", max(0.0, float(rises.max())) / blow, 0.0, 1e-3,
              "contacts take energy; where the ball strikes, solves hit their limit, and moving overlaps apart lifts"),
        Check("deepest overlap once at rest", depth, 0.0, 1e-4, THOUSANDTH, "m"),
        Check("rms speed when woken there", speed, 0.0, 1e-3, "a tenth of what gravity gives in a step", "m/s"),
    ]  # fmt: skip
    return checks, {**series, "boxes": [len(moved)], "blow": [blow], "not_converged": [not_converged]}


def _scene(layers: int) -> tuple[Any, slice]:
    """Square layers on each other, and a ball that flies into their upper half; the boxes are all but the last."""
    pitch = EDGE + GAP
    boxes = [
        body(
            f"box{layer}_{row}_{column}",
            {"type": "box", "size": (EDGE, EDGE, EDGE)},
            position=(pitch * (row - 0.5 * (size - 1)), pitch * (column - 0.5 * (size - 1)), (layer + 0.5) * EDGE),
            friction=FRICTION,
        )
        for layer, size in enumerate(range(layers, 0, -1))
        for row in range(size)
        for column in range(size)
    ]
    half = 0.5 * pitch * layers
    place = (-half - AWAY, 0.0, 0.5 * layers * EDGE + RADIUS)
    ball = body("ball", {"type": "sphere", "radius": RADIUS}, position=place, velocity=(SPEED, 0.0, 0.0),
                density=DENSITY, friction=FRICTION)  # fmt: skip
    hall = DomainParameters(min=(-4.0 * half, -3.0 * half, 0.0), max=(FAR_WALL, 3.0 * half, 4.0))
    solver = make_bodies(*boxes, ball, domain=hall)
    solver.has_own_steps = True
    return solver, slice(0, -1)


def _frame(solver: Any, frame: int) -> dict[str, float]:
    """One frame, and what the solver tells of it."""
    solver.begin_frame((frame - 1) / FRAMES_PER_SECOND)
    for _ in steps(solver, 1.0 / FRAMES_PER_SECOND):
        pass
    return dict(solver.diagnostics())


def _kinetic_energy(bodies: Any, which: slice) -> float:
    """Of some bodies [J]."""
    of_ways = bodies.mass[which, None] * np.square(bodies.velocity[which])
    of_turns = (bodies.angular_momentum() * bodies.angular_velocity)[which]
    return 0.5 * float(of_ways.sum() + of_turns.sum())


def draw(results: Sequence[CaseResult]) -> Figure:
    """Kinetic energy, who sleeps, and depth over time."""
    figure, (energy, asleep, depth) = make_panels(3)
    series = results[0].series
    blow, times = series["blow"][0], series["times"]
    energy.semilogy(times, [max(each, 1e-9 * blow) / blow for each in series["kinetic"]], color=SHADES[0])
    title = f"{series['boxes'][0]:,} boxes"
    label_axes(energy, "time [s]", "kinetic energy / the ball's", title, legend=False)
    asleep.plot(times, [100.0 * each for each in series["asleep"]], color=SHADES[0])
    label_axes(asleep, "time [s]", "boxes asleep [%]", "rest", legend=False)
    depth.plot(times, series["depth_mm"], color=SHADES[0])
    depth.set_ylim(bottom=0.0)
    label_axes(depth, "time [s]", "deepest overlap [mm]", "overlap", legend=False)
    return figure


CASE = Case(find, draw, solvers=("rigid",), sizes={"layers": (14, 5), "most_frames": (600, 240)})
