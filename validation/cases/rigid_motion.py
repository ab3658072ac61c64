"""Rigid bodies that touch nothing: free fall, rotation without torque, and the flip of a tennis racket."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import COLOURS, draw_refinement, label_axes, make_panels
from validation.scenes import GRAVITY, WEIGHTLESS, advance, body, make_bodies

SIZE = (0.1, 0.2, 0.3)  # edges of the box [m]; its moments of inertia are all different
SPIN = (4.0, 5.0, 3.0)  # angular velocity at the start [rad/s]
DURATION = 10.0  # of the rotation without torque [s]
STEPS = (8e-3, 4e-3, 2e-3)  # time steps of the convergence [s]
RACKET_SPIN, NUDGE, RACKET_DURATION = 10.0, 0.1, 4.0  # spin, disturbance about the other axes [rad/s]; [s]


def find(_: str) -> Found:
    """Fall, rotation and flip."""
    fall = _free_fall()
    rotation = _torque_free()
    errors = [_rotation_error(step) for step in STEPS]
    racket = _racket()
    checks = [
        Check("distance of 1 s of free fall over g t²/2", fall["distance"], 1.0, 1e-9,
              "exact for constant gravity; float64"),
        Check("speed over g t", fall["speed"], 1.0, 1e-9, "likewise"),
        Check("drift of |L| in 10 s", rotation["momentum_drift"], 0.0, 1e-9,
              "5e-3 is required; a splitting into rotations keeps it to round-off"),
        Check("drift of the direction of L in 10 s", rotation["direction_drift"], 0.0, 1e-9, "likewise", "rad"),
        Check("largest deviation of the energy in 10 s", rotation["energy_deviation"], 0.0, 1e-4,
              "a symplectic splitting: it oscillates with (omega dt)², 2e-4 here, times a small factor, without drift"),
        Check("order of the rotation in the time step", fitted_order(STEPS, errors), 2.0, 0.1, "a symmetric splitting"),
        Check("time between two flips of the racket over theory", racket["period"] / racket["exact"], 1.0, 0.01,
              "the period hangs on the logarithm of the nudge, which an error of 1e-4 in the spin changes by 1e-3"),
        Check("flips about the middle axis in 4 s", racket["flips"], racket["expected_flips"], 0.0, "a count"),
        Check("flips about the other axes in 4 s", racket["stable_flips"], 0.0, 0.0, "rotation about those is stable"),
    ]  # fmt: skip
    series = {"steps": list(STEPS), "errors": errors, **rotation["series"], **racket["series"]}
    return checks, series


def _box(spin: Any) -> Any:
    box = body("box", {"type": "box", "size": SIZE}, position=(0.0, 0.0, 5.0), angular_velocity=tuple(spin))
    return make_bodies(box, gravity=WEIGHTLESS)


def _free_fall() -> dict[str, float]:
    solver = make_bodies(body("ball", {"type": "sphere", "radius": 0.1}, position=(0.0, 0.0, 8.0)))
    for _ in advance(solver, 1.0, cuts=60):
        pass
    distance, speed = 8.0 - solver.bodies.position[0, 2], -solver.bodies.velocity[0, 2]
    return {"distance": float(distance) / (0.5 * GRAVITY), "speed": float(speed) / GRAVITY}


def _torque_free() -> dict[str, Any]:
    solver = _box(SPIN)

    def spin_energy() -> float:
        return 0.5 * float(solver.bodies.angular_momentum()[0] @ solver.bodies.angular_velocity[0])

    start, energy = solver.bodies.angular_momentum()[0], spin_energy()
    times, sizes, angles, energies, spins = [], [], [], [], []
    for time in advance(solver, DURATION, cuts=600):
        now = solver.bodies.angular_momentum()[0]
        times.append(time)
        sizes.append(float(np.linalg.norm(now) / np.linalg.norm(start)) - 1.0)
        angles.append(float(np.linalg.norm(np.cross(now, start)) / np.linalg.norm(start) ** 2))
        energies.append(spin_energy() / energy - 1.0)
        spins.append(_spin_in_body(solver))
    return {
        "momentum_drift": float(np.abs(sizes).max()),
        "direction_drift": max(angles),
        "energy_deviation": float(np.abs(energies).max()),
        "series": {"times": times[::4], "energies": energies[::4], "spins": np.array(spins)[::4].T.tolist()},
    }


def _spin_in_body(solver: Any) -> np.ndarray:
    return solver.bodies.rotation()[0].T @ solver.bodies.angular_velocity[0]


def _euler(solver: Any) -> Callable[[float, np.ndarray], np.ndarray]:
    """Rates of a spin in body axes by Euler's equations."""
    inertia = solver.solids[0].mass_properties(700.0).inertia
    inverse = np.linalg.inv(inertia)
    return lambda _, spin: inverse @ -np.cross(spin, inertia @ spin)


def _rotation_error(step: float) -> float:
    """Error of the angular velocity in body axes after 2 s against an integration to 1e-12 [rad/s]."""
    from scipy.integrate import solve_ivp

    solver = _box(SPIN)
    exact = solve_ivp(_euler(solver), (0.0, 2.0), SPIN, rtol=1e-12, atol=1e-12).y[:, -1]
    for _ in range(round(2.0 / step)):
        solver.substep(step)
    return float(np.linalg.norm(_spin_in_body(solver) - exact))


def _racket() -> dict[str, Any]:
    """Flips of spins about each axis; the exact time between two is half a period of the elliptic function."""
    from scipy.integrate import solve_ivp

    flips, series = [], {}
    for axis in range(3):
        spin = np.full(3, NUDGE)
        spin[axis] = RACKET_SPIN
        solver = _box(spin)
        order = np.argsort(np.diag(solver.solids[0].mass_properties(700.0).inertia))
        times, along = [0.0], [1.0]
        for time in advance(solver, RACKET_DURATION, cuts=800):
            times.append(time)
            along.append(float(_spin_in_body(solver)[axis]) / RACKET_SPIN)
        changes = np.flatnonzero(np.diff(np.sign(along)))
        flips.append(len(changes))
        if axis == order[1]:
            middle, crossings = axis, np.array(times)[changes]
            series = {"racket_times": times[::2], "racket_spin": along[::2]}

    def crossing(_: float, rates: np.ndarray) -> float:
        return float(rates[middle])

    spin = np.full(3, NUDGE)
    spin[middle] = RACKET_SPIN
    exact = solve_ivp(_euler(solver), (0.0, RACKET_DURATION), spin, rtol=1e-12, atol=1e-14, events=crossing).t_events[0]
    return {
        "period": float(np.diff(crossings).mean()),
        "exact": float(np.diff(exact).mean()),
        "flips": float(flips[middle]),
        "expected_flips": float(len(exact)),
        "stable_flips": float(sum(flips) - flips[middle]),
        "series": series,
    }


def draw(results: Sequence[CaseResult]) -> Figure:
    """Energy of a free rotation, the racket's flips, refinement."""
    figure, (energy, racket, order) = make_panels(3)
    series, colour = results[0].series, COLOURS["rigid"]
    energy.plot(series["times"], [1e6 * each for each in series["energies"]], color=colour, linewidth=0.8)
    label_axes(energy, "time [s]", "energy / that of the start - 1  [1e-6]", "rotation without torque", legend=False)
    racket.plot(series["racket_times"], series["racket_spin"], color=colour)
    label_axes(racket, "time [s]", "spin about the middle axis / start", "tennis racket", legend=False)
    errors = (series["steps"], series["errors"], {"color": colour, "label": "after 2 s"})
    draw_refinement(
        order, [errors], 2, "time step [ms]", "error of the spin [rad/s]", tick=lambda step: f"{1e3 * step:g}"
    )
    return figure


CASE = Case(find, draw, solvers=("rigid",))
