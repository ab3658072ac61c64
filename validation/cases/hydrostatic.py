"""A column of water at rest: its pressure is rho g (H - z) and the floor bears its weight."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import THEORY, draw_refinement, label_axes, make_panels, refinement_of, style_of
from validation.scenes import GRAVITY, WATER, advance, lattice, make_fluid, state_of, wall_forces

HEIGHT, SIDE, DURATION = 0.2, 0.1, 2.0  # of the column [m], and how long it stands [s]
SETTLED = 1.0  # from here on the sound of the start is averaged away [s]
MEAN_OF = 20  # samples of the running mean of the force that is drawn


def stand(solver: str, layers: int) -> dict[str, Any]:
    """Let a column of so many layers of particles stand; profile, force on the floor and speeds."""
    spacing = HEIGHT / layers
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(SIDE, SIDE, 2.0 * HEIGHT))
    fluid = make_fluid(solver, domain, lattice((0.0,) * 3, (SIDE, SIDE, HEIGHT), spacing), spacing=spacing)
    before = fluid.diagnostics()
    weight = before["mass"] * GRAVITY
    surface = before["mass"] / (WATER * SIDE**2)
    times, forces, speeds, heights, pressures = [], [], [], [], []
    for time in advance(fluid, DURATION, cuts=200):
        position, velocity = state_of(fluid)
        times.append(time)
        speeds.append(float(np.sqrt((velocity**2).sum(axis=1).mean())))
        samples, pushes = wall_forces(fluid)
        of_floor = samples[:, 2] < -0.5 * spacing  # which lie 0.95 spacings deep; other walls end 0.05 beneath
        forces.append(-float(pushes[of_floor, 2].sum()) / weight)
        if time > SETTLED:
            heights.append(position[:, 2])
            pressures.append(fluid.snapshots()[fluid.name].arrays["pressure"])
    height, pressure = np.mean(heights, axis=0), np.mean(pressures, axis=0)
    after = fluid.diagnostics()
    scale = WATER * GRAVITY * surface
    layer = np.clip((height / surface * layers).astype(int), 0, layers - 1)
    means = np.array([pressure[layer == k].mean() for k in range(layers)])
    middles = np.array([height[layer == k].mean() for k in range(layers)])
    exact = WATER * GRAVITY * (surface - middles)
    settled = np.array(times) > SETTLED
    return {
        "times": times,
        "speeds": speeds,
        "forces": forces,
        "depth": ((surface - middles) / surface).tolist(),
        "pressure": (means / scale).tolist(),
        "force": float(np.mean(np.array(forces)[settled])),
        "slope": float(np.polyfit(surface - middles, means, 1)[0]) / (WATER * GRAVITY),
        "error": float(np.sqrt(np.mean((means - exact) ** 2)) / scale),
        "rest_speed": float(np.mean(np.array(speeds)[settled])) / np.sqrt(GRAVITY * HEIGHT),
        "energy_gain": (
            sum(after[name] - before[name] for name in ("kinetic_energy", "potential_energy")) / (weight * HEIGHT)
        ),
        "wall_contacts": after["wall_contacts"],
        "not_converged": after.get("not_converged", 0.0),
    }


def find(solver: str, layers: Sequence[int]) -> Found:
    """The column at several resolutions, in layers of particles."""
    runs = [stand(solver, count) for count in layers]
    finest = runs[-1]
    checks = [
        Check("force on the floor over the weight", finest["force"], 1.0, 0.01, "the required 1 %; mean of 1 s"),
        Check("slope of the pressure over rho g", finest["slope"], 1.0, 1.0 / layers[-1],
              "first order: one layer's worth"),
        Check("error of the pressure profile over that of a layer's weight, the largest of all resolutions",
              max(count * each["error"] for count, each in zip(layers, runs, strict=True)), 0.0, 0.5,
              "first order: a quarter of a layer at floor and surface each (rms)"),
        Check("rms speed at rest over sqrt(g H)", finest["rest_speed"], 0.0, 0.03,
              "what moves is under a thousandth of the energy that the column has to give, m g H/2"),
        Check("energy gained over m g H", max(0.0, finest["energy_gain"]), 0.0, 1e-4,
              "float32 sums; it may lose any"),
        Check("particles put back by a wall", finest["wall_contacts"], 0.0, 0.0, "a count"),
        Check("pressure solves that did not converge", finest["not_converged"], 0.0, 0.0, "a count"),
    ]  # fmt: skip
    series = {"layers": list(layers), "errors": [each["error"] for each in runs]}
    for count, each in zip(layers, runs, strict=True):
        series |= {f"{name}_{count}": each[name] for name in ("depth", "pressure")}
    series |= {name: finest[name] for name in ("times", "speeds", "forces")}
    return checks, series


def draw(results: Sequence[CaseResult]) -> Figure:
    """Pressure over depth, force on the floor over time, refinement."""
    figure, (profile, force, order) = make_panels(3)
    for result in results:
        series, style, finest = result.series, style_of(result), max(result.series["layers"])
        profile.plot(series[f"pressure_{finest}"], series[f"depth_{finest}"], "o", markersize=3, **style)
        means = np.convolve(series["forces"], np.full(MEAN_OF, 1.0 / MEAN_OF), mode="valid")
        force.plot(series["times"][MEAN_OF - 1 :], means, linewidth=1.0, **style)
    profile.plot([0.0, 1.0], [0.0, 1.0], color=THEORY, linewidth=1.0, label="rho g (H - z)")
    profile.invert_yaxis()
    label_axes(profile, "p / rho g H", "depth / H", "pressure, mean of 1 s")
    force.axhline(1.0, color=THEORY, linewidth=1.0)
    force.set_ylim(0.9, 1.1)
    label_axes(force, "time [s]", "force on the floor / weight", "force, mean of the last 0.2 s")
    draw_refinement(order, refinement_of(results, "layers"), 1, "spacing / H", "rms error / rho g H")
    return figure


CASE = Case(find, draw, sizes={"layers": ((8, 16, 32), (8, 16))})
