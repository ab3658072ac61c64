"""Joints: a double pendulum and a slider-crank against their equations, and a chain with a hundredfold weight."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import COLOURS, draw_refinement, label_axes, make_panels
from validation.scenes import GRAVITY, advance, body, make_bodies

LENGTH, WIDTH, HEIGHT = 0.5, 0.04, 2.0  # bars of the pendulum, and its height over the floor [m]
DURATION = 2.0  # of the pendulum [s]: it turns over once; errors grow exponentially from then on
STEPS = (4e-3, 2e-3, 1e-3)  # [s]
CRANK, ROD, SPEED = 0.1, 0.3, 10.0  # [m], [m], [rad/s]
LINKS, PITCH, RATIO = 10, 0.1, 100.0  # of the chain; [m]; mass of the weight over that of a link
CHAIN_DURATION = 1.6  # [s]: it swings through, and its end whips over
ACROSS = (0.0, 1.0, 0.0)


def find(_: str) -> Found:
    """Pendulum, crank and chain."""
    pendulums = [_pendulum(step) for step in STEPS]
    errors, crank, chain = [each["error"] for each in pendulums], _crank(), _chain()
    checks = [
        Check("error of the double pendulum's angles in 2 s, steps of 2 ms", errors[1], 0.0, 1e-3,
              "second order, (omega dt)² of 1e-4 where it is fastest, and the errors grow as it turns over", "rad"),
        Check("order of that error in the time step", fitted_order(STEPS, errors), 2.0, 0.1, "RATTLE is symmetric"),
        Check("largest deviation of its energy over m g L", pendulums[1]["energy"], 0.0, 1e-3,
              "it oscillates with (omega dt)²"),
        Check("largest gap of its hinges", max(each["gap"] for each in pendulums), 0.0, 1e-9,
              "where Newton's method ends", "m"),
        Check("largest error of the piston's place in a turn", crank["error"], 0.0, 1e-9,
              "geometry; joints hold to 1e-9 m", "m"),
        Check("largest gap of the chain's joints", chain["gap"], 0.0, 1e-8,
              "solved at once, whatever the masses; in a whip the method ends with more left", "m"),
        Check("largest deviation of the chain's energy over m g L", chain["energy"], 0.0, 0.01,
              "it oscillates while the chain swings; when the end whips over, links turn by 0.1 rad a step"),
    ]  # fmt: skip
    return checks, {
        "steps": list(STEPS),
        "errors": errors,
        **pendulums[1]["series"],
        **crank["series"],
        **chain["series"],
    }


def _hinge(name: str, between: Sequence[str], place: Sequence[float], **more: Any) -> dict[str, Any]:
    return {"name": name, "kind": "hinge", "between": between, "anchor": place, "axis": ACROSS, **more}


def _energy(solver: Any) -> float:
    numbers = solver.diagnostics()
    return float(numbers["kinetic_energy"] + numbers["potential_energy"])


def _pendulum(step: float) -> dict[str, Any]:
    """Two bars that fall from the level, against Lagrange's equations."""
    from scipy.integrate import solve_ivp

    size = (LENGTH, WIDTH, WIDTH)
    bars = [
        body(name, {"type": "box", "size": size}, position=(x, 0.0, HEIGHT)) for name, x in (("a", 0.25), ("b", 0.75))
    ]
    joints = [_hinge("top", ("a",), (0.0, 0.0, HEIGHT)), _hinge("middle", ("b", "a"), (LENGTH, 0.0, HEIGHT))]
    solver = make_bodies(*bars, joints=joints)
    mass = float(solver.bodies.mass[0])
    moment, link = mass * (LENGTH**2 + WIDTH**2) / 12.0, 0.5 * mass * LENGTH**2

    def rates(_: float, state: np.ndarray) -> list[float]:
        a, b, w, v = state
        cosine, sine = math.cos(a - b), math.sin(a - b)
        matrix = [[moment + 2.5 * link, link * cosine], [link * cosine, moment + 0.5 * link]]
        weight = mass * GRAVITY * LENGTH
        right = [-link * sine * v**2 + 1.5 * weight * math.cos(a), link * sine * w**2 + 0.5 * weight * math.cos(b)]
        return [w, v, *np.linalg.solve(matrix, right)]

    count, start = round(DURATION / step), _energy(solver)
    times = step * np.arange(1, count + 1)
    exact = solve_ivp(rates, (0.0, DURATION), np.zeros(4), t_eval=times, rtol=1e-12, atol=1e-12).y[:2]
    found, energies = [], []
    for _ in range(count):
        solver.substep(step)
        turned = solver.bodies.rotation()
        found.append(np.arctan2(-turned[:, 2, 0], turned[:, 0, 0]))
        energies.append(_energy(solver) / (mass * GRAVITY * LENGTH))
    angles = np.unwrap(np.array(found), axis=0).T
    every = max(1, count // 200)
    series = {
        "times": times[::every].tolist(),
        "angles": np.degrees(angles)[:, ::every].tolist(),
        "exact": np.degrees(exact)[:, ::every].tolist(),
    }
    deviation = np.abs(np.array(energies) - start / (mass * GRAVITY * LENGTH)).max()
    error, gap = float(np.abs(angles - exact).max()), float(solver.diagnostics()["joint_gap"])
    return {"error": error, "energy": float(deviation), "gap": gap, "series": series}


def _crank() -> dict[str, Any]:
    """A motor turns the crank once; the piston is where geometry says."""
    thin = (0.02, 0.02)
    bodies = [
        body("crank", {"type": "box", "size": (CRANK, *thin)}, position=(0.5 * CRANK, 0.0, 1.0)),
        body("rod", {"type": "box", "size": (ROD, *thin)}, position=(CRANK + 0.5 * ROD, 0.0, 1.0)),
        body("piston", {"type": "box", "size": (0.05, 0.05, 0.05)}, position=(CRANK + ROD, 0.0, 1.0)),
    ]
    joints = [
        _hinge("shaft", ("crank",), (0.0, 0.0, 1.0), motor={"speed": SPEED, "max_torque": 1e3}),
        _hinge("pin", ("rod", "crank"), (CRANK, 0.0, 1.0)),
        _hinge("gudgeon", ("rod", "piston"), (CRANK + ROD, 0.0, 1.0)),
        {"name": "guide", "kind": "slider", "between": ("piston",), "axis": (1.0, 0.0, 0.0)},
    ]
    solver = make_bodies(*bodies, joints=joints)
    solver.bodies.angular_velocity[0, 1] = SPEED
    step, times, found, exact = 1e-3, [], [], []
    for number in range(1, round(2.0 * math.pi / SPEED / step) + 1):
        solver.substep(step)
        angle = SPEED * number * step
        times.append(number * step)
        found.append(float(solver.bodies.position[2, 0]))
        exact.append(CRANK * math.cos(angle) + math.sqrt(ROD**2 - (CRANK * math.sin(angle)) ** 2))
    error = float(np.abs(np.array(found) - exact).max())
    return {"error": error, "series": {"crank_times": times[::4], "piston": found[::4], "piston_exact": exact[::4]}}


def _chain() -> dict[str, Any]:
    """Ten links from the level, with a weight of a hundred links at the end."""
    shape = {"type": "capsule", "radius": 0.01, "height": 0.06}
    places = [((number + 0.5) * PITCH, 0.0, HEIGHT) for number in range(LINKS)]
    links = [
        body(f"link{number}", shape, position=place, rotation_deg=(0.0, 90.0, 0.0))
        for number, place in enumerate(places)
    ]
    link = 700.0 * math.pi * (0.01**2 * 0.06 + 4.0 / 3.0 * 0.01**3)
    weight = {"type": "box", "size": (PITCH, PITCH, PITCH)}
    end = body("weight", weight, position=(LINKS * PITCH, 0.0, HEIGHT), density=RATIO * link / PITCH**3)
    names = ["", *(each.name for each in (*links, end))]
    joints = [
        {"name": f"joint{number}", "kind": "ball", "between": tuple(filter(None, pair)),
         "anchor": (number * PITCH, 0.0, HEIGHT)}
        for number, pair in enumerate(itertools.pairwise(names))
    ]  # fmt: skip
    solver = make_bodies(*links, end, joints=joints)
    scale = float(solver.bodies.mass[-1]) * GRAVITY * LINKS * PITCH
    start, times, energies = _energy(solver), [], []
    for time in advance(solver, CHAIN_DURATION, cuts=round(500 * CHAIN_DURATION)):
        times.append(time)
        energies.append((_energy(solver) - start) / scale)
    series = {"chain_times": times[::4], "chain_energies": energies[::4]}
    return {"gap": float(solver.diagnostics()["joint_gap"]), "energy": float(np.abs(energies).max()), "series": series}


def draw(results: Sequence[CaseResult]) -> Figure:
    """Angles of the pendulum, its refinement, and the piston's place."""
    figure, (pendulum, order, crank) = make_panels(3)
    series, colour = results[0].series, COLOURS["rigid"]
    theory = {"color": "0.7", "linewidth": 3.0}
    pendulum.plot(series["times"], np.transpose(series["exact"]), **theory, label=["theory", ""])
    pendulum.plot(series["times"], np.transpose(series["angles"]), "--", color=colour, label=["computed", ""])
    label_axes(pendulum, "time [s]", "angle [°]", "double pendulum")
    errors = (series["steps"], series["errors"], {"color": colour, "label": "in 2 s"})
    draw_refinement(
        order, [errors], 2, "time step [ms]", "largest error of the angles [rad]", tick=lambda step: f"{1e3 * step:g}"
    )
    crank.plot(series["crank_times"], series["piston_exact"], **theory)
    crank.plot(series["crank_times"], series["piston"], "--", color=colour)
    label_axes(crank, "time [s]", "place of the piston [m]", "slider-crank", legend=False)
    return figure


CASE = Case(find, draw, solvers=("rigid",))
