"""Rigid bodies that touch: a bounce, a stack, a slope, and a collision."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import SHADES, THEORY, label_axes, make_panels, plot_each
from validation.scenes import EVERY_FACE, GRAVITY, HALL, WEIGHTLESS, advance, body, make_bodies, recorded

RADIUS, DROP_HEIGHT = 0.1, 1.0
BOXES, EDGE, STACK_DURATION = 5, 0.2, 5.0
SLOPE_DEG, SLIDING_FRICTION, STICKING_FRICTION = 30.0, 0.2, 0.8  # tan 30° = 0.577 lies between the two coefficients


def find(_: str, restitutions: Sequence[float]) -> Found:
    """Bounces, a stack, two slopes and a collision."""
    bounces = {restitution: _bounce(restitution) for restitution in restitutions}
    stack = _stack()
    angle = np.radians(SLOPE_DEG)
    sliding = _slope(SLIDING_FRICTION)
    sticking = _slope(STICKING_FRICTION)
    collision = _collision()
    exact = GRAVITY * (np.sin(angle) - SLIDING_FRICTION * np.cos(angle))
    checks = [
        *(
            Check(f"height of the first bounce over e² h, e = {restitution:g}", bounce["height"], 1.0, 0.01,
                  "the required 1 %; the impact is found to a step, and gravity's part of it is left out")
            for restitution, bounce in bounces.items()
        ),
        Check("largest displacement of a box of the stack in 5 s", stack["displacement"], 0.0, 1e-4,
              "half a thousandth of an edge: it stays put to the eye, with room for settling", "m"),
        Check("largest tilt of a box of the stack after 5 s", stack["tilt"], 0.0, 1e-3, "1 mrad is 0.2 mm at its edge",
              "rad"),
        Check("speed of the stack after 5 s", stack["speed"], 0.0, 1e-3, "a tenth of what gravity gives in a step",
              "m/s"),
        Check("acceleration down the slope over g (sin - mu cos)", sliding["acceleration"] / exact, 1.0, 0.01,
              "1 %: friction is solved to the tolerance of the contact solver"),
        Check("distance down the slope in 1 s with mu above tan", sticking["distance"], 0.0, 1e-4, "it must stick",
              "m"),
        Check("linear momentum after a collision over before, less 1", collision["linear"], 0.0, 1e-10,
              "equal and opposite impulses in float64"),
        Check("angular momentum after a collision, likewise", collision["angular"], 0.0, 1e-10,
              "at one point: 1e-10 leaves room for 1e4 roundings"),
        Check("kinetic energy gained in the collision", max(0.0, collision["energy"] - 1.0), 0.0, 1e-9,
              "a contact may only take energy"),
    ]  # fmt: skip
    series: dict[str, Any] = {"restitutions": list(bounces), "heights": [each["height"] for each in bounces.values()]}
    for restitution, bounce in bounces.items():
        series |= {f"{name}_{restitution:g}": bounce[name] for name in ("times", "path")}
    series |= {"stack_times": stack["times"], "stack_displacements": stack["displacements"]}
    series |= {"slope_times": sliding["times"], "slope_distances": sliding["distances"]}
    series |= {"stuck_distances": sticking["distances"]}
    return checks, series


def _bounce(restitution: float) -> dict[str, Any]:
    """A ball that falls onto the floor: its height above the floor over time, and that of the first bounce."""
    at = (0.0, 0.0, RADIUS + DROP_HEIGHT)
    solver = make_bodies(body("ball", {"type": "sphere", "radius": RADIUS}, position=at, restitution=restitution))
    duration = np.sqrt(2.0 * DROP_HEIGHT / GRAVITY) * (1.0 + 1.5 * restitution)
    found = recorded(solver, duration, cuts=400, path=lambda: solver.bodies.position[0, 2] - RADIUS)
    times, path = [0.0, *found["times"]], [DROP_HEIGHT, *found["path"]]
    rebound = np.argmin(path[:300])
    return {"times": times, "path": path, "height": max(path[int(rebound) :]) / (restitution**2 * DROP_HEIGHT)}


def _stack() -> dict[str, Any]:
    boxes = [
        body(f"box{k}", {"type": "box", "size": (EDGE,) * 3}, position=(0.0, 0.0, EDGE * (k + 0.5)), friction=0.5)
        for k in range(BOXES)
    ]
    solver = make_bodies(*boxes)
    start = solver.bodies.position.copy()
    found = recorded(
        solver,
        STACK_DURATION,
        cuts=50,
        displacements=lambda: np.linalg.norm(solver.bodies.position - start, axis=1).max(),
    )
    # The angle of a rotation matrix from its axis vector; exact for small ones, where the trace is not.
    turned = solver.bodies.rotation()
    tilt = 0.5 * np.linalg.norm([turned[:, i, j] - turned[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=0)
    speed = float(np.linalg.norm(solver.bodies.velocity, axis=1).max())
    return {**found, "displacement": max(found["displacements"]), "tilt": float(tilt.max()), "speed": speed}


def _slope(friction: float) -> dict[str, Any]:
    """A box on an inclined static slab: distance down the slope over time and acceleration."""
    angle = np.radians(SLOPE_DEG)
    normal, down = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, -np.sin(angle)])
    centre = np.array([0.0, 0.0, 4.0])
    how: dict[str, Any] = {"rotation_deg": (0.0, SLOPE_DEG, 0.0), "friction": friction}
    slab = body("slab", {"type": "box", "size": (8.0, 1.0, 0.5)}, kind="static", position=tuple(centre), **how)
    at = tuple(centre + normal * (0.25 + 0.1) - 3.0 * down)
    solver = make_bodies(body("box", {"type": "box", "size": (0.3, 0.3, 0.2)}, position=at, **how), obstacles=[slab])
    start = solver.bodies.position[0].copy()
    found = recorded(solver, 1.0, cuts=50, start=True, distances=lambda: (solver.bodies.position[0] - start) @ down)
    acceleration = float(solver.bodies.velocity[0] @ down) / 1.0
    return {**found, "distance": max(np.abs(found["distances"])), "acceleration": acceleration}


def _collision() -> dict[str, float]:
    """A spinning box hits a ball off its centre, without gravity: totals after over totals before."""
    surface = {"friction": 0.4, "restitution": 0.5}
    motion = {"position": (-0.4, 0.05, 5.0), "velocity": (2.0, 0.0, 0.0), "angular_velocity": (1.0, 2.0, 3.0)}
    box = body("box", {"type": "box", "size": (0.3, 0.2, 0.1)}, **motion, **surface)
    ball = body("ball", {"type": "sphere", "radius": 0.12}, position=(0.0, 0.0, 5.0), **surface)
    domain = DomainParameters(min=HALL.min, max=HALL.max, open_faces=EVERY_FACE)
    solver = make_bodies(box, ball, gravity=WEIGHTLESS, domain=domain)
    before = solver.diagnostics()
    for _ in advance(solver, 0.5, cuts=50):
        pass
    after = solver.diagnostics()
    if np.linalg.norm(solver.bodies.velocity[1]) < 0.1:
        raise RuntimeError("the box missed the ball")

    def drift(quantity: str) -> float:
        start, end = (np.array([state[f"{quantity}_{axis}"] for axis in "xyz"]) for state in (before, after))
        return float(np.linalg.norm(end - start) / np.linalg.norm(start))

    return {
        "linear": drift("momentum"),
        "angular": drift("angular_momentum"),
        "energy": after["kinetic_energy"] / before["kinetic_energy"],
    }


def draw(results: Sequence[CaseResult]) -> Figure:
    """Bounces, the slope, the stack."""
    figure, (bounce, slope, stack) = make_panels(3)
    series = results[0].series
    for e, shade in zip(series["restitutions"], SHADES, strict=False):
        bounce.plot(series[f"times_{e:g}"], series[f"path_{e:g}"], color=shade, label=f"e = {e:g}")
        bounce.axhline(e**2, color=shade, linewidth=0.7, linestyle=":")
    label_axes(bounce, "time [s]", "height / h", "bounce; dotted: e²")
    plot_each(slope, series, "slope_times", {"slope_distances": "mu = 0.2", "stuck_distances": "mu = 0.8"})
    exact = [0.5 * GRAVITY * (0.5 - SLIDING_FRICTION * 0.75**0.5) * time**2 for time in series["slope_times"]]
    slope.plot(series["slope_times"], exact, ":", color=THEORY, label="theory")
    label_axes(slope, "time [s]", "distance down the slope [m]", "slope of 30°")
    plot_each(stack, series, "stack_times", {"stack_displacements": ""}, scale=1e6)
    stack.set_ylim(bottom=0.0)
    label_axes(stack, "time [s]", "largest displacement of a box [micrometres]", "stack of five", legend=False)
    return figure


CASE = Case(find, draw, solvers=("rigid",), sizes={"restitutions": ((0.3, 0.5, 0.8, 0.95), (0.5, 0.8))})
