"""Air and smoke beside solids that cut cells: order of convergence, a channel askew to the grid, thin walls, a ball."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from sim.scene import SceneParameters
from sim.smoke.grid import SmokeGrid
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import SHADES, THEORY, draw_refinement, label_axes, make_panels
from validation.smoke_boxes import AMBIENT, Array, build_box

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

INNER, OUTER, MIDDLE = 0.17, 0.43, (0.503, 0.497, 0.5017)  # radii and middle of the shell of air [m]
TOLERANCE, MAX_ITERATIONS = 2.0e-6, 60
CHANNEL_DEG, WIDTH, WIND, CHANNEL_DURATION = 30.0, 0.4, 1.0, 1.0  # slope; [m]; [m/s]; [s]
WALL_CELLS, ROOM_CELLS, ROOM_DURATION = 1.2, 32, 2.0  # thickness of the room's walls; across the box; [s]
ROOM, ROOM_DEG = 0.3, (20.0, 12.0)  # half an edge of the room [m]; it is turned about x, then y
BALL, BALL_SPEED, BALL_CELLS = 0.2, 0.3, 48  # [m], [m/s], across the box
FPS = 60.0


class Region:
    """A solid that is given by a function of places, (n, 3)."""

    bounds = np.array([[-9.0] * 3, [9.0] * 3])

    def __init__(self, distance: Any) -> None:
        self.signed_distance = distance


def find(_: str, cells: Sequence[int], channel_cells: int) -> Found:
    """The projection between two spheres, wind through a channel, smoke in a room, air pushed by a ball."""
    errors = [_shell_error(n) for n in cells]
    spacings = [1.0 / n for n in cells]
    rms, largest = ([each[n] for each in errors] for n in range(2))
    flux, uneven, profile = _channel(channel_cells)
    leaked = _leaked()
    displaced, pushed = _displaced()
    checks = [
        Check("order of the projected velocity between two spheres, rms", fitted_order(spacings, rms), 2.0, 0.15,
              "central differences, and areas of linear distances; 0.6 with whole cells"),
        Check("the same, its largest error", fitted_order(spacings, largest), 1.5, 0.35,
              "at single faces that are cut it is of first order; whole cells do not converge there"),
        Check("flux through a channel that is turned by 30 degrees, over that of even wind", flux, 1.0, 0.002,
              "exact is 1, and even wind is a solution; measured"),
        Check("rms of its velocity off even wind, over the wind", uneven, 0.0, 0.01, "measured"),
        Check("share of the smoke that leaves a turned room with walls of 1.2 cells in 2 s", leaked, 0.0, 0.0,
              "no face is open between its sides"),
        Check("area with which a ball of ten cells pushes air, over that of its section", displaced, 1.0, 0.01,
              "required; distances are linear in cells, so a convex body is a little smaller"),
        Check("air that flows back through its middle plane over its section times its speed", pushed, 1.0, 0.01,
              "required, in a closed box"),
    ]  # fmt: skip
    series = {"cells": list(cells), "rms": rms, "largest": largest, **profile}
    return checks, series


def _shell_error(n: int) -> tuple[float, float]:
    """Error of a projection between two spheres: root mean square by area, and largest, over the largest exact speed.

    The flow turns evenly about the z axis, v = e_z x (x - m), and so along both spheres; grad p with
    p = 0.3 cos(pi (r - R1) / (R2 - R1)) x y / r² is added, which has no part across them, and has to go.
    """
    from sim.smoke.arrays import new_faces
    from sim.smoke.obstacles import Obstacles
    from sim.smoke.projection import PressureProjection

    shell = Region(lambda x: np.minimum(_radius(x) - INNER, OUTER - _radius(x)))
    grid = SmokeGrid.of_cells((0.0, 0.0, 0.0), 1.0 / n, (n, n, n), frozenset()).with_solids([shell])
    obstacles, faces = Obstacles(grid), new_faces(grid.size)
    projection = PressureProjection(obstacles, faces, tolerance=TOLERANCE, max_iterations=MAX_ITERATIONS)
    exact, areas = [], []
    for axis, array in enumerate(faces):
        shape, places = grid.face_shape(axis), grid.face_centres(axis)
        areas.append(grid.trim(obstacles.solids.area[axis].to_numpy(), shape).astype(np.float64))
        exact.append(_turning(places)[:, axis].reshape(shape))
        given = exact[-1] + _slope(places)[:, axis].reshape(shape)
        array.from_numpy(grid.pad((given * (areas[-1] > 0.0)).astype(np.float32)).ravel())
    projection.project()
    off = [grid.trim(array.to_numpy(), grid.face_shape(axis)) - exact[axis] for axis, array in enumerate(faces)]
    errors = np.concatenate([each[area > 0.0] for each, area in zip(off, areas, strict=True)])
    weights = np.concatenate([area[area > 0.0] for area in areas])
    return float(np.sqrt(np.average(errors**2, weights=weights))) / OUTER, float(np.abs(errors).max()) / OUTER


def _radius(places: Array) -> Array:
    radius: Array = np.linalg.norm(places - MIDDLE, axis=1)
    return radius


def _turning(places: Array) -> Array:
    x, y, _ = (places - MIDDLE).T
    return np.stack([-y, x, np.zeros_like(x)], axis=1)


def _slope(places: Array) -> Array:
    """Of p [m/s]."""
    x, y, z = (places - MIDDLE).T
    r, k = _radius(places), math.pi / (OUTER - INNER)
    along, across = np.cos(k * (r - INNER)), -k * np.sin(k * (r - INNER))
    harmonic = x * y / r**2
    turned = np.stack([y - 2.0 * x * harmonic, x - 2.0 * y * harmonic, -2.0 * z * harmonic], axis=1) / r[:, None] ** 2
    return 0.3 * ((across * harmonic / r)[:, None] * (places - MIDDLE) + along[:, None] * turned)


def _channel(n: int) -> tuple[float, float, dict[str, list[float]]]:
    """Wind through a channel that rises: its flux and its unevenness after a second, and its profile in the middle."""
    slope = math.radians(CHANNEL_DEG)
    cos, sin = math.cos(slope), math.sin(slope)
    walls = Region(lambda x: 0.5 * WIDTH - np.abs(cos * (x[:, 2] - 0.5) - sin * (x[:, 0] - 0.5)))
    wind, sides = (WIND * cos, 0.0, WIND * sin), ("x-", "x+", "z-")
    solver = build_box((n, 4, n), 1.0 / n, solids=[walls], wind=wind, open_faces=sides)
    solver.begin_frame(0.0)
    _advance(solver, CHANNEL_DURATION)
    off, weights = [], []
    for axis, exact in ((0, cos), (2, sin)):
        area, speed = _faces(solver, axis)
        inner = (slice(n // 4, 3 * n // 4),)
        off.append((speed - WIND * exact)[inner].ravel())
        weights.append(area[inner].ravel())
    uneven = math.sqrt(np.average(np.concatenate(off) ** 2, weights=np.concatenate(weights))) / WIND
    area, speed = _faces(solver, 0)
    flux = float((area * speed)[n // 2].sum() / area[n // 2].sum()) / (WIND * cos)
    is_open = area[n // 2, 1] > 0.0
    heights = ((np.arange(n) + 0.5) / n)[is_open]
    return flux, uneven, {"height": heights.tolist(), "speed": (speed[n // 2, 1][is_open] / (WIND * cos)).tolist()}


def _leaked() -> float:
    """Share of the smoke of a hot source that gets out of a closed room whose walls are turned against the grid."""
    x_turn, y_turn = (math.radians(angle) for angle in ROOM_DEG)
    about_x = np.array([[1, 0, 0], [0, math.cos(x_turn), -math.sin(x_turn)], [0, math.sin(x_turn), math.cos(x_turn)]])
    about_y = np.array([[math.cos(y_turn), 0, math.sin(y_turn)], [0, 1, 0], [-math.sin(y_turn), 0, math.cos(y_turn)]])

    def beyond(places: Array) -> Array:
        from_middle: Array = np.abs((places - 0.5) @ (about_y @ about_x)) - ROOM
        outside = np.linalg.norm(np.maximum(from_middle, 0.0), axis=1)
        distance: Array = outside + np.minimum(from_middle.max(axis=1), 0.0)
        return distance

    walls = Region(lambda places: np.abs(beyond(places)) - 0.5 * WALL_CELLS / ROOM_CELLS)
    source = {"shape": {"type": "sphere", "radius": 0.12}, "position": (0.5, 0.5, 0.4), "temperature": AMBIENT + 150.0}
    cells = (ROOM_CELLS,) * 3
    solver = build_box(cells, 1.0 / ROOM_CELLS, solids=[walls], source=[source], gravity=(0.0, 0.0, -9.81))
    solver.begin_frame(0.0)
    _advance(solver, ROOM_DURATION)
    density = solver.snapshots()["air"].arrays["density"].astype(np.float64)
    outside = beyond(solver.grid.cell_centres()).reshape(cells) > 0.0
    return float(density[outside].sum() / density.sum())


def _displaced() -> tuple[float, float]:
    """Section of a moving ball as air feels it, and what flows back beside its middle, over the exact ones."""
    from sim.build import build_world

    ball = {"name": "ball", "kind": "kinematic", "shape": {"type": "sphere", "radius": BALL}}
    ball |= {"position": (0.5 - 0.5 * BALL_SPEED / FPS, 0.5, 0.5), "velocity": (BALL_SPEED, 0.0, 0.0)}
    idle = {"shape": {"type": "sphere", "radius": 0.05}, "position": (0.1, 0.1, 0.1), "start_s": 1.0e6}
    smoke = {"name": "air", "cell_size": 1.0 / BALL_CELLS, "open_faces": (), "source": [idle]}
    scene = {"domain": {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)}, "rigid": [ball], "smoke": [smoke]}
    world = build_world(SceneParameters.model_validate({**scene, "gravity": (0.0, 0.0, 0.0)}), frames_per_second=FPS)
    world.advance_frame()
    area, speed = _faces(world.solvers["air"], 0)
    section, middle = math.pi * BALL**2 * BALL_CELLS**2, BALL_CELLS // 2
    return (
        float((1.0 - area[middle]).sum()) / section,
        float(-(area * speed)[middle].sum()) / (section * BALL_SPEED),
    )


def _faces(solver: Any, axis: int) -> tuple[Array, Array]:
    """Open parts and velocities [m/s] of the faces across an axis."""
    grid, name = solver.grid, ("u_face_x", "v_face_y", "w_face_z")[axis]
    shape = grid.face_shape(axis)
    area, speed = solver.obstacles.solids.area[axis].to_numpy(), solver.checkpoint()[name]
    return grid.trim(area, shape).astype(np.float64), grid.trim(speed, shape).astype(np.float64)


def _advance(solver: SmokeSolver, duration: float) -> None:
    end = solver.time_s + duration
    while solver.time_s < end - 1.0e-9:
        solver.substep(min(solver.stable_dt(), 1.0 / FPS, end - solver.time_s))


def draw(results: Sequence[CaseResult]) -> Figure:
    """Refinement between two spheres, and the profile of the channel."""
    figure, (order, channel) = make_panels(2, width=4.2)
    series = results[0].series
    spacings = [1.0 / count for count in series["cells"]]
    curves = [
        (spacings, series[name], {"color": shade, "label": label})
        for (name, label), shade in zip({"rms": "rms", "largest": "largest"}.items(), SHADES, strict=False)
    ]
    draw_refinement(order, curves, 2, "cell / box", "error / largest speed", title="projection between two spheres")
    channel.plot(series["speed"], series["height"], "o-", markersize=4, color=SHADES[0], label="after 1 s")
    channel.axvline(1.0, color=THEORY, linewidth=1.0, linestyle="--", label="even wind")
    channel.set_xlim(0.0, 1.2)
    label_axes(channel, "velocity / wind", "height [m]", "channel turned by 30°")
    return figure


SIZES = {
    "cells": ((16, 32, 64), (16, 32)),  # across the box of the two spheres
    "channel_cells": (48, 24),  # across that of the channel
}
CASE = Case(find, draw, solvers=("smoke",), sizes=SIZES)
