"""Cloth that hangs, swings, falls, folds and is hit: stretch, sag, period, energy, speed, crossings, momentum."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.core.domain import DomainParameters
from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.crossing_triangles import crossings
from validation.figures import SHADES, draw_refinement, label_axes, make_panels, plot_each
from validation.scenes import EVERY_FACE, GRAVITY
from validation.sheet_energy import elastic_energy

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver

THREADS_ALONE: dict[str, Any] = {"shear_stiffness": 0.0, "bend_stiffness": 0.0, "air_density": 0.0}
SOFT: dict[str, Any] = {"mass_per_area": 0.2, "stretch_stiffness": 100.0}
"""Mass per area [kg/m²] and stretch stiffness [N/m] of what explicit springs compute."""

SUPPLE: dict[str, Any] = {"shear_stiffness": 20.0, "bend_stiffness": 1e-5, "air_density": 0.0, **SOFT}

COLUMN_ROWS, COLUMN_MASS, COLUMN_WIDTH = 21, 0.15, 0.05  # [-], [kg/m²], [m]; the hanging column is 1 m long
COTTON = 4000.0  # stretch stiffness of cotton [N/m]
SPAN, BAND_WIDTH = 0.5, 0.1  # length between the bars and width of the band [m]
SHEET, SHEET_NODES = 0.2, 6  # side [m] and nodes along it of the swinging sheet
MESH_ROWS, MESH_COLUMNS = 28, 24  # rows and columns of cells of the hanging mesh, of equal triangles, 1 m high
BALL_DENSITIES = (1000.0, 30.0)  # of the ball that hits a free sheet of 18 g [kg/m³]: 524 g and 16 g
FOLDED, FOLDED_THICKNESS = 0.5, 3e-3  # side and thickness of the sheet that falls on its edge [m]


def find(
    _: str,
    *,
    cells: Sequence[int],
    swinging_s: float,
    nodes: int,
    folding: int,
    hitting: int,
    integrators: Sequence[str],
) -> Found:
    """Column, mesh, band, pendulum, swinging, falling and folding sheet, sheet and ball."""
    columns = {name: _column(name, stiffness) for name, stiffness in (("xpbd", COTTON), ("explicit", 60.0))}
    exact_sag = _catenary_sag()
    errors = [abs(_band_sag(count) - exact_sag) for count in cells]
    energy = _swinging_sheet(swinging_s)
    folded = _folded_drop(nodes=nodes, frames=folding)
    periods = {name: _pendulum(name) for name in ("xpbd", "explicit")}
    drifts = {
        (name, density): _ball_and_sheet(name, density, frames=hitting)
        for name in integrators
        for density in BALL_DENSITIES
    }
    checks = [
        *[
            Check(f"largest error of a row's stretch, {name}", float(np.abs(column["ratio"] - 1.0).max()), 0.0, 0.01,
                  "required; threads up to 64 springs long are solved exactly, float32 tells 1e-4 of the stretch of "
                  "cotton")
            for name, column in columns.items()
        ],
        Check("lengthening of a hanging mesh over theory, xpbd", _hanging_mesh(), 1.0, 0.05,
              "required, 0.01 mm of a metre of cotton; triangles are solved together"),
        Check("order of the sag of a band in the spacing", fitted_order([1.0 / count for count in cells], errors), 2.0,
              0.2, "lumped masses and chords for the arc are of second order"),
        Check("error of the sag at 8 cells over the sag", errors[1] / exact_sag, 0.0, 0.01, "1/(2 n²) of a parabola"),
        *[
            Check(f"period of a pendulum over theory, {name}", period, 1.0, 5e-4,
                  "chords of 7 ms of its path, and its spring sways")
            for name, period in periods.items()
        ],
        Check("largest deviation of the energy of a swinging sheet", energy["deviation"], 0.0, 0.01,
              "required over 10 s; without damping, of m g L/2, explicit at its own step"),
        Check("terminal speed of a falling sheet over theory", _terminal_speed(), 1.0, 1e-3,
              "implicit drag is exact there; the sheet sways by 1e-4"),
        Check("edges through triangles of a sheet folded by its fall, sum over frames", float(sum(folded["crossings"])),
              0.0, 0.0, "required; counted by exact arithmetic that shares no code with the solver"),
        Check("crossings that the solver had to leave", float(sum(folded["left"])), 0.0, 0.0, "a count"),
        *[
            Check(f"drift of {quantity} momentum, ball of {density:g} kg/m³ and free sheet, {name}", drift, 0.0, 1e-4,
                  "required; springs, contacts and friction keep it to rounding")
            for (name, density), both in drifts.items()
            for quantity, drift in zip(("linear", "angular"), both, strict=True)
        ],
    ]  # fmt: skip
    series = {
        "cells": list(cells),
        "errors": errors,
        "times": energy["times"],
        "energies": energy["energies"],
        "kinetic": energy["kinetic"],
        **{f"folded_{name}": values for name, values in folded.items()},
    }
    for name, column in columns.items():
        series |= {f"rows_{name}": list(range(1, COLUMN_ROWS)), f"ratio_{name}": column["ratio"]}
        series |= {f"stretch_{name}": column["stretch"], f"theory_{name}": column["theory"]}
    return checks, series


def _solver(**keys: Any) -> ClothSolver:
    from sim.cloth.solver import ClothSolver

    cloth = ClothParameters.model_validate({"name": "cloth", **keys})
    return ClothSolver([cloth], domain=DomainParameters(), gravity=(0.0, 0.0, -GRAVITY), frames_per_second=60.0)


def _rectangle(size: tuple[float, float], counts: tuple[int, int]) -> dict[str, Any]:
    return {"type": "rectangle", "size": size, "counts": counts}


def _settle(solver: ClothSolver, spans: tuple[float, ...]) -> None:
    """Dynamic relaxation: let it move for each span of time [s], and stop it."""
    for span in spans:
        for _ in range(round(span / solver.stable_dt())):
            solver.substep(solver.stable_dt())
        solver.state.velocity.fill(0.0)


def _column(integrator: str, stiffness: float) -> dict[str, NDArray[np.float64]]:
    """Stretch of each row of a strip of two threads under the weight below it, from the upper row on."""
    spacing = 1.0 / (COLUMN_ROWS - 1)
    hung = {"rotation_deg": (90, 0, 0), "pin": [{"edge": "y+"}], "integrator": integrator}
    stuff = {"mass_per_area": COLUMN_MASS, "stretch_stiffness": stiffness, "damping": 2e-3, **THREADS_ALONE}
    solver = _solver(shape=_rectangle((COLUMN_WIDTH, 1.0), (2, COLUMN_ROWS)), **hung, **stuff)
    # A quarter of its period is sqrt(m / E): 6 ms and 50 ms; 16 ms are twenty steps of XPBD.
    _settle(solver, (0.016,) * 40 if integrator == "xpbd" else (0.05, 0.033) * 8)
    heights = solver.state.positions()[:, 2].reshape(COLUMN_ROWS, 2)[::-1].mean(axis=1)
    weight = COLUMN_MASS * COLUMN_WIDTH * GRAVITY * (np.arange(COLUMN_ROWS - 1, 0, -1) - 0.5) * spacing
    stretch, theory = -np.diff(heights) - spacing, weight * spacing / (stiffness * COLUMN_WIDTH)
    return {"stretch": stretch, "theory": theory, "ratio": stretch / theory}


def _hanging_mesh() -> float:
    """How much longer a mesh of equal triangles gets in its middle as it hangs from an edge, over rho g H² / (2 E)."""
    import trimesh

    j, i = (each.ravel() for each in np.mgrid[0 : MESH_ROWS + 1, 0 : MESH_COLUMNS + 1])
    edge = 1.0 / (MESH_ROWS * math.sqrt(0.75))
    vertices = np.stack([(i + 0.5 * (j % 2)) * edge, 0.0 * i, 0.5 - j / MESH_ROWS], axis=1)
    a = np.flatnonzero((i < MESH_COLUMNS) & (j < MESH_ROWS))
    odd, below = j[a] % 2, a + MESH_COLUMNS + 1
    triangles = np.concatenate(
        [np.stack([a, a + 1, below + odd], axis=1), np.stack([below, below + 1, a + 1 - odd], axis=1)]
    )
    upper_edge = {"type": "box", "min": (-1, -1, 0.499), "max": (1, 1, 0.501)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sheet.stl"
        trimesh.Trimesh(vertices, triangles, process=False).export(path)
        stuff = {"mass_per_area": COLUMN_MASS, "stretch_stiffness": COTTON, "damping": 2e-3}
        free = {"bend_stiffness": 0.0, "air_density": 0.0}
        solver = _solver(shape={"type": "mesh", "file": str(path)}, pin=[{"region": upper_edge}], **stuff, **free)
    start = solver.state.positions()
    _settle(solver, (0.033,) * 12)
    lower_edge = (start[:, 2] < -0.499) & (np.abs(start[:, 0]) < 0.25)
    longer = float((start - solver.state.positions())[lower_edge, 2].mean())
    return longer / (COLUMN_MASS * GRAVITY / (2.0 * COTTON))


def _catenary_sag() -> float:
    """Sag [m] of an elastic band between two bars as far apart as it is long (Irvine 1981, "Cable structures", 1.3).

    x(s) = H s / E + H/w asinh(w s / H),  z(s) = w s² / (2 E) + H/w ((1 + (w s / H)²)^(1/2) - 1), from its middle.
    """
    from scipy.optimize import brentq

    half, weight = 0.5 * SPAN, SOFT["mass_per_area"] * GRAVITY * BAND_WIDTH
    stiffness = SOFT["stretch_stiffness"] * BAND_WIDTH

    def miss(h: float) -> float:
        return h * half / stiffness + h / weight * math.asinh(weight * half / h) - half

    h = float(brentq(miss, 1e-6 * weight * SPAN, stiffness))
    return weight * half**2 / (2 * stiffness) + h / weight * (math.hypot(1.0, weight * half / h) - 1.0)


def _band_sag(cells: int) -> float:
    held = {"shape": _rectangle((SPAN, BAND_WIDTH), (cells + 1, 2)), "pin": [{"edge": "x-"}, {"edge": "x+"}]}
    solver = _solver(**held, damping=2e-3, integrator="explicit", **SOFT, **THREADS_ALONE)
    _settle(solver, (0.05, 0.033) * 14)  # a quarter of its swing, and another that stops what the first does not
    return -float(solver.state.positions()[:, 2].min())


def _pendulum(integrator: str) -> float:
    """Period of two nodes on a short strip over 2 pi (L/g)^(1/2) (1 + a²/16), its length stretched by its weight."""
    stiffness, length, angle = 200.0, 0.25, math.radians(5.0)
    hung = {"rotation_deg": (85, 0, 0), "pin": [{"edge": "y+"}], "integrator": integrator}
    stuff = {"mass_per_area": 0.2, "stretch_stiffness": stiffness, "bend_damping": 0.0, **THREADS_ALONE}
    solver = _solver(shape=_rectangle((0.1, length), (2, 2)), **hung, **stuff)
    dt, times = solver.stable_dt(), []
    start = solver.state.positions()
    anchor, side = start[2, 1], start[0, 1] - start[2, 1]
    for step in range(round(2.6 / dt)):
        solver.substep(dt)
        if step % 8 == 7:
            before, side = side, float(solver.state.positions()[0, 1] - anchor)
            if side * before < 0.0:
                times.append(dt * (step + 1 - 8 * side / (side - before)))
    stretched = length * (1.0 + 0.5 * 0.2 * length * GRAVITY / stiffness)
    exact = 2.0 * math.pi * math.sqrt(stretched / GRAVITY) * (1.0 + angle**2 / 16.0)
    return 2.0 * float(np.diff(times).mean()) / exact


def _swinging_sheet(duration: float) -> dict[str, Any]:
    """Energy of an undamped sheet that falls from flat, held at two corners, over m g L / 2."""
    sheet = _rectangle((SHEET, SHEET), (SHEET_NODES, SHEET_NODES))
    held = {"pin": [{"corner": "x-y-"}, {"corner": "x+y-"}], "integrator": "explicit"}
    solver = _solver(shape=sheet, **held, bend_damping=0.0, **SUPPLE)
    dt, times, energies, kinetic = solver.stable_dt(), [], [], []
    mass = solver.state.mass.to_numpy().astype(np.float64)
    scale = mass.sum() * GRAVITY * 0.5 * SHEET
    steps = round(duration / dt)
    for step in range(steps):
        solver.substep(dt)
        if step % max(1, steps // 500) == 0:
            # Velocities are those of half a step ago (leapfrog); so are these positions.
            velocity = solver.state.velocity.to_numpy().astype(np.float64)
            positions = solver.state.positions() - 0.5 * dt * velocity
            moving = 0.5 * float(mass @ (velocity**2).sum(axis=1))
            elastic = elastic_energy(solver, positions)
            times.append((step + 1) * dt)
            kinetic.append(moving / scale)
            energies.append((moving + elastic + GRAVITY * float(mass @ positions[:, 2])) / scale)
    return {
        "times": times,
        "energies": energies,
        "kinetic": kinetic,
        "deviation": float(np.abs(energies).max()),
    }


def _terminal_speed() -> float:
    """Speed of a sheet that has fallen flat for twenty times v/g, over (2 m g / rho C)^(1/2)."""
    solver = _solver(shape=_rectangle((0.2, 0.2), (4, 4)), mass_per_area=0.05, air_density=1.2, drag=1.3, skin_drag=0.0)
    for _ in range(round(1.5 / solver.stable_dt())):
        solver.substep(solver.stable_dt())
    speed = -float(solver.state.velocity.to_numpy()[:, 2].mean())
    return speed / math.sqrt(2.0 * 0.05 * GRAVITY / (1.2 * 1.3))


def _folded_drop(*, nodes: int, frames: int) -> dict[str, list[float]]:
    """A square sheet that falls on its edge and folds, frame by frame: edges through triangles, and contacts."""
    from sim.build import build_world
    from sim.cloth.solver import ClothSolver

    sheet = {"name": "sheet", "shape": _rectangle((FOLDED, FOLDED), (nodes, nodes)), "thickness": FOLDED_THICKNESS}
    sheet |= {"position": (0.0, 0.0, 0.55 * FOLDED), "rotation_deg": (85.0, 7.0, 0.0), "air_density": 0.0}
    room = {"min": (-1.0, -1.0, 0.0), "max": (1.0, 1.0, 2.0)}
    scene = SceneParameters.model_validate({"gravity": (0, 0, -GRAVITY), "domain": room, "cloth": [sheet]})
    world = build_world(scene, frames_per_second=60.0)
    cloth = world.solvers["cloth"]
    if not isinstance(cloth, ClothSolver):
        raise TypeError(f"the solver of a sheet is a {type(cloth).__name__}")
    series: dict[str, list[float]] = {name: [] for name in ("times", "crossings", "contacts", "left", "height")}
    for frame in range(frames):
        numbers = world.advance_frame().diagnostics["cloth"]
        positions = cloth.state.positions()
        series["times"].append((frame + 1) / 60.0)
        series["crossings"].append(len(crossings(positions, cloth.state.host.triangles)))
        series["contacts"].append(numbers["contacts"])
        series["left"].append(numbers["crossings_left"])
        series["height"].append(float(positions[:, 2].max()))
    return series


def _ball_and_sheet(integrator: str, density: float, *, frames: int) -> tuple[float, float]:
    """Largest change of linear and angular momentum of a spinning ball and the free sheet that it hits, over theirs."""
    from sim.build import build_world
    from sim.cloth.solver import ClothSolver
    from sim.rigid.solver import RigidSolver

    ball = {"name": "ball", "kind": "dynamic", "density": density, "shape": {"type": "sphere", "radius": 0.05}}
    ball |= {"position": (0.03, 0.01, 0.06), "velocity": (0.3, 0.0, -3.0), "angular_velocity": (0.0, 20.0, 5.0)}
    sheet = {"name": "sheet", "shape": _rectangle((0.3, 0.3), (11, 11)), "thickness": 2e-3}
    sheet |= {"self_collision": False, "integrator": integrator, **SUPPLE}
    space = {"min": (-1.0,) * 3, "max": (1.0,) * 3, "open_faces": EVERY_FACE}
    scene = SceneParameters.model_validate({"gravity": (0, 0, 0), "domain": space, "cloth": [sheet], "rigid": [ball]})
    world = build_world(scene, frames_per_second=60.0)
    solvers = world._solvers.values()
    cloth = next(each for each in solvers if isinstance(each, ClothSolver))
    bodies = next(each for each in solvers if isinstance(each, RigidSolver)).bodies
    mass = cloth.state.mass.to_numpy().astype(np.float64)[:, None]

    def totals() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        parts = mass * cloth.state.velocity.to_numpy()
        of_ball = bodies.mass[:, None] * bodies.velocity
        spin = np.cross(bodies.position, of_ball) + bodies.angular_momentum()
        angular = np.cross(cloth.state.positions(), parts).sum(axis=0) + spin.sum(axis=0)
        return parts.sum(axis=0) + of_ball.sum(axis=0), angular

    start, worst = totals(), [0.0, 0.0]
    for _ in range(frames):
        world.advance_frame()
        drifts = [
            float(np.linalg.norm(now - before) / np.linalg.norm(before))
            for now, before in zip(totals(), start, strict=True)
        ]
        worst = [max(pair) for pair in zip(worst, drifts, strict=True)]
    return worst[0], worst[1]


def draw(results: Sequence[CaseResult]) -> Figure:
    """Stretch of a column by rows, refinement of a band's sag, energy of a swinging sheet, crossings of a folded."""
    figure, (column, order, energy, folded) = make_panels(4)
    series = results[0].series
    for name, label, shade in (("xpbd", "XPBD, cotton", SHADES[0]), ("explicit", "explicit, 60 N/m", SHADES[1])):
        relative = [100.0 * (ratio - 1.0) for ratio in series[f"ratio_{name}"]]
        column.plot(series[f"rows_{name}"], relative, "o-", markersize=3, color=shade, label=label)
    column.axhspan(-1.0, 1.0, color="#eeeeee", zorder=0)
    column.set_ylim(-1.5, 1.5)
    label_axes(column, "row from above", "stretch / theory - 1  [%]", "hanging column; grey: 1 %")
    band = {"color": SHADES[0], "label": "band between two bars"}
    spacings = [1.0 / count for count in series["cells"]]
    draw_refinement(order, [(spacings, series["errors"], band)], 2, "spacing / span", "error of the sag [m]")
    plot_each(energy, series, "times", {"energies": ""}, scale=100.0, linewidth=0.8)
    energy.set_ylim(-1.0, 1.0)
    label_axes(energy, "time [s]", "energy - start / (m g L/2)  [%]", "undamped sheet, explicit", legend=False)
    shown = {"folded_crossings": "edges through triangles", "folded_contacts": "contacts a substep"}
    plot_each(folded, series, "folded_times", shown)
    most = max(series["folded_contacts"])
    folded.set_ylim(-0.05 * most, 1.4 * most)
    nodes = results[0].settings["nodes"]
    label_axes(folded, "time [s]", "number", f"folded drop, {nodes} x {nodes} nodes", legend="upper right")
    return figure


SIZES = {
    "cells": ((4, 8, 16), (4, 8)),  # of the band between its bars
    "swinging_s": (10.0, 0.5),
    "nodes": (81, 41),  # along each side of the sheet that folds
    "folding": (60, 20),  # frames of its fall
    "hitting": (20, 4),  # frames of the ball and the sheet
    "integrators": (("xpbd", "explicit"), ("xpbd",)),  # of the sheet that the ball hits
}
CASE = Case(find, draw, solvers=("cloth",), sizes=SIZES)
