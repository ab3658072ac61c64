"""Cloth that falls, crumples, is twisted, pressed, pinched, shot at and pulled away: what passes through what.

    python -m validation.cases.cloth_crossings [SCENE ...] [--nodes 32] [--share 1.0]

prints a table, then JSON; the scenes are built and stepped as a job's are, with the defaults of one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim.scene import SceneParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.crossing_triangles import crossings
from validation.figures import SHADES, label_axes, make_panels
from validation.scenes import GRAVITY

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.core.world import World
    from sim.shapes.body_geometry import BodyGeometry

Scene = dict[str, Any]
Points = NDArray[np.float64]

STEEL, GLASS, PORCELAIN = 7800.0, 2500.0, 2400.0  # [kg/m³]
FUNNEL_HALF = 0.12  # half width of the funnel's hole [m]
PELLET_SPEED = 150.0  # [m/s]

ROOM = {"min": (-2.0, -2.0, 0.0), "max": (2.0, 2.0, 3.0), "open_faces": ("x-", "x+", "y-", "y+", "z+")}
CUTS = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
"""Barycentric coordinates of the points of a triangle at which bodies are looked for."""


# --- the scenes -----------------------------------------------------------------------------------------------------


def sheet(side: float, nodes: int, height: float, **keys: Any) -> Scene:
    """A square of cotton [m]."""
    shape = {"type": "rectangle", "size": (side, side), "counts": (nodes, nodes)}
    return {"name": "cloth", "shape": shape, "position": (0.0, 0.0, height), **keys}


def scene_of(cloths: Sequence[Scene], bodies: Sequence[Scene] = (), **keys: Any) -> Scene:
    """Cloths and bodies, named in their order, in a hall with a floor."""
    return {
        "domain": ROOM,
        "gravity": (0.0, 0.0, -GRAVITY),
        "cloth": [{**each, "name": f"cloth{k}"} for k, each in enumerate(cloths)],
        "rigid": [{"name": f"body{k}", **each} for k, each in enumerate(bodies)],
        **keys,
    }


def ball(radius: float, position: Sequence[float], **keys: Any) -> Scene:
    """A ball [m]."""
    return {"shape": {"type": "sphere", "radius": radius}, "position": position, **keys}


def box(size: Sequence[float], position: Sequence[float], **keys: Any) -> Scene:
    """A box [m]."""
    return {"shape": {"type": "box", "size": size}, "position": position, **keys}


def led(*ways: tuple[float, tuple[float, float, float]]) -> Scene:
    """A body that moves through places [m] at times [s]."""
    return {"kind": "kinematic", "keyframe": [{"time_s": time, "position": place} for time, place in ways]}


def over_a_ball(nodes: int) -> Scene:
    """A square metre that falls onto a ball."""
    return scene_of([sheet(1.0, nodes, 0.7)], [ball(0.25, (0.01, 0.02, 0.4))])


def in_a_funnel(nodes: int) -> Scene:
    """Four boards that slope by 45 degrees towards a square hole over the floor."""
    slope, thick = np.sqrt(0.5), 0.1
    out, up = FUNNEL_HALF + 0.35 * slope + 0.5 * thick * slope, 0.1 + 0.35 * slope - 0.5 * thick * slope
    boards = [
        box((0.7, 1.3, thick), (out * np.cos(a), out * np.sin(a), up), rotation_deg=(0.0, -45.0, np.degrees(a)))
        for a in 0.5 * np.pi * np.arange(4)
    ]
    return scene_of([sheet(0.9, nodes, 0.75, rotation_deg=(4.0, 3.0, 20.0))], boards)


def twisted(nodes: int) -> Scene:
    """A tube of which both ends turn, once in a second against each other, and come nearer."""
    import trimesh

    length, radius = 0.8, 0.8 / (2.0 * np.pi)
    row, column = (each.ravel() for each in np.mgrid[0:nodes, 0:nodes])
    angle = 2.0 * np.pi * (column + 0.5 * (row % 2)) / nodes
    x = length * (row / (nodes - 1) - 0.5)
    tube = np.stack([x, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    a = np.flatnonzero(row < nodes - 1)
    odd, beside = row[a] % 2, row[a] * nodes + (column[a] + 1) % nodes
    below, below_beside = a + nodes, beside + nodes
    lower = np.where(odd, below_beside, below)
    triangles = np.concatenate(
        [np.stack([a, beside, lower], axis=1), np.stack([below, below_beside, np.where(odd, a, beside)], axis=1)]
    )
    path = Path(tempfile.mkdtemp()) / "tube.ply"
    trimesh.Trimesh(tube, triangles, process=False).export(path)
    pins = []
    for side in (-1.0, 1.0):
        end = 0.5 * length * side
        low, high = sorted((end - 1e-3 * side, end + 1e-3 * side))
        way = [
            {"time_s": 0.25 * k, "offset": (-0.03 * side * k, 0.0, 0.0), "rotation_deg": (45.0 * side * k, 0.0, 0.0)}
            for k in range(9)
        ]
        region = {"type": "box", "min": (low, -1.0, 0.0), "max": (high, 1.0, 2.0)}
        pins.append({"region": region, "keyframe": way, "interpolation": "linear"})
    cloth = {"shape": {"type": "mesh", "file": str(path)}, "position": (0.0, 0.0, 1.0), "pin": pins}
    return scene_of([cloth])


def knotted(nodes: int) -> Scene:
    """A strip, four times as long as wide, of which one end makes four turns in two seconds; both come nearer."""
    shape = {"type": "rectangle", "size": (0.8, 0.2), "counts": (2 * nodes, max(nodes // 2, 3))}
    turns = [
        {"time_s": 0.125 * k, "offset": (-0.03 * k, 0.0, 0.0), "rotation_deg": (90.0 * k, 0.0, 0.0)} for k in range(17)
    ]
    return scene_of(
        [{"shape": shape, "position": (0.0, 0.0, 1.0), "pin": [{"edge": "x-"}, {"edge": "x+", "keyframe": turns}]}]
    )


def layers(count: int) -> Callable[[int], Scene]:
    """So many sheets on the floor, and two bodies of 50 kg on them, a box and a ball."""

    def scene(nodes: int) -> Scene:
        side = round(nodes * (2.0 / count) ** 0.5)
        sheets = [sheet(1.0, side, 1e-3 * (k + 1), rotation_deg=(0.0, 0.0, 7.0 * k)) for k in range(count)]
        top, steel = 1e-3 * (count + 1), {"kind": "dynamic", "density": STEEL}
        cube = box((0.2, 0.2, 0.16), (-0.25, 0.0, top + 0.1), **steel)
        heavy = [cube, ball(0.115, (0.25, 0.0, top + 0.135), **steel)]
        return scene_of(sheets, heavy)

    return scene


def pinched(nodes: int) -> Scene:
    """A hanging sheet between two plates that close upon it and lift it; a ball of 20 kg rides on another."""
    hanging = sheet(0.6, nodes, 1.0, rotation_deg=(90.0, 0.0, 0.0), pin=[{"edge": "y+"}])
    lying = {**sheet(0.6, nodes, 0.305), "position": (1.0, 0.0, 0.305)}
    plates = [
        {
            "shape": {"type": "box", "size": (0.2, 0.04, 0.2)},
            **led(
                (0.0, (0.0, 0.12 * side, 0.9)),
                (0.4, (0.0, 0.0206 * side, 0.9)),
                (0.5, (0.0, 0.0206 * side, 0.9)),
                (0.9, (0.1, 0.0206 * side, 1.0)),
            ),
        }
        for side in (-1.0, 1.0)
    ]
    platform = {
        "shape": {"type": "box", "size": (0.5, 0.5, 0.1)},
        **led((0.0, (1.0, 0.0, 0.25)), (0.4, (1.0, 0.0, 0.25)), (1.2, (1.1, 0.0, 0.45))),
    }
    rider = ball(0.085, (1.0, 0.0, 0.4), kind="dynamic", density=STEEL)
    return scene_of([hanging, lying], [*plates, platform, rider])


def shot_at(nodes: int) -> Scene:
    """A hanging sheet, and a steel pellet of 2 g that meets it between its nodes."""
    hanging = sheet(0.4, nodes, 1.0, rotation_deg=(90.0, 0.0, 0.0), pin=[{"edge": "y+"}])
    middle = 0.5 * 0.4 / (nodes - 1)
    pellet = ball(0.004, (middle, -1.3, 1.0 + middle), kind="dynamic", density=STEEL, velocity=(0.0, PELLET_SPEED, 0.0))
    return scene_of([hanging], [pellet])


def tablecloth(nodes: int) -> Scene:
    """A cloth that is pulled from under three plates and a glass, by 0.9 m in a quarter of a second."""
    way = [{"time_s": t, "offset": (x, 0.0, 0.0)} for t, x in ((0.0, 0.0), (0.3, 0.0), (0.55, 0.9))]
    cloth = sheet(0.7, nodes, 0.502, pin=[{"edge": "x+", "keyframe": way, "interpolation": "linear"}])
    table = box((0.8, 0.8, 0.1), (0.0, 0.0, 0.45))

    def dish(radius: float, height: float, x: float, y: float, density: float) -> Scene:
        shape = {"type": "cylinder", "radius": radius, "height": height}
        place = (x, y, 0.51 + 0.5 * height)
        return {"shape": shape, "position": place, "kind": "dynamic", "density": density, "friction": 0.1}

    dishes = [dish(0.08, 0.02, x, y, PORCELAIN) for x, y in ((-0.15, 0.15), (-0.15, -0.15), (0.15, -0.15))]
    return scene_of([cloth], [table, *dishes, dish(0.03, 0.1, 0.15, 0.15, GLASS)])


SCENES: dict[str, tuple[Callable[[int], Scene], int]] = {
    "ball": (over_a_ball, 80),
    "funnel": (in_a_funnel, 90),
    "twisted column": (twisted, 75),
    "knot": (knotted, 120),
    "two layers": (layers(2), 60),
    "five layers": (layers(5), 60),
    "pinched": (pinched, 75),
    "pellet": (shot_at, 30),
    "tablecloth": (tablecloth, 60),
}
"""How each is built, and its frames."""


# --- what is measured -----------------------------------------------------------------------------------------------


def measure(name: str, nodes: int, share: float = 1.0) -> dict[str, Any]:
    """What happens in a scene of so many nodes a side, in a share of its frames, frame by frame."""
    from sim.build import build_world
    from sim.cloth.solver import ClothSolver

    build, frames = SCENES[name]
    world = build_world(SceneParameters.model_validate(build(nodes)), frames_per_second=60.0)
    cloth = world.solvers["cloth"]
    if not isinstance(cloth, ClothSolver):
        raise TypeError(f"the solver of cloth is a {type(cloth).__name__}")
    corners = cloth.state.host.triangles
    rows: dict[str, list[float]] = {
        key: [] for key in ("crossings", "depth_mm", "passed", "strain", "substeps", "ms", "left", "zoned", "told")
    }
    watch = _Watch(world, cloth)
    world.watch = watch
    for _ in range(max(round(share * frames), 1)):
        watch.passed, watch.spent_s = 0, 0.0
        start = time.process_time()
        report = world.advance_frame()
        spent, numbers = time.process_time() - start - watch.spent_s, report.diagnostics["cloth"]
        rows["crossings"].append(len(crossings(watch.positions, corners)))
        rows["depth_mm"].append(1e3 * max([0.0, *(depth_in(body, watch.positions[corners]) for body in watch.bodies)]))
        rows["passed"].append(watch.passed)
        rows["strain"].append(numbers["max_strain"])
        rows["substeps"].append(report.substeps["cloth"])
        rows["ms"].append(1e3 * spent)
        rows["left"].append(numbers["crossings_left"])
        rows["zoned"].append(numbers["impact_zone_vertices"])
        rows["told"].append(numbers.get("bodies_show", 0.0))
    return {"scene": name, "nodes": len(watch.positions), "frames": len(rows["ms"]), **rows}


class _Watch:
    """Counts after every substep how often the middles of bodies have passed cloth; what it looked at, and its time."""

    def __init__(self, world: World, cloth: ClothSolver) -> None:
        self._world, self._cloth = world, cloth
        self.positions, self.bodies = cloth.state.positions(), bodies_of(world)
        self.passed, self.spent_s = 0, 0.0

    def __call__(self) -> None:
        start, corners = time.process_time(), self._cloth.state.host.triangles
        before, bodies = self.positions, self.bodies
        self.positions, self.bodies = self._cloth.state.positions(), bodies_of(self._world)
        self.passed += sum(
            passes(before[corners] - old[1], self.positions[corners] - new[1])
            for old, new in zip(bodies, self.bodies, strict=True)
        )
        self.spent_s += time.process_time() - start


def bodies_of(world: World) -> list[tuple[BodyGeometry, Points, Points]]:
    """Shape, place and turn of every body, as the cloth's contacts know them."""
    from sim.cloth.solver import ClothSolver

    found = []
    for cloth in world.solvers.values():
        if isinstance(cloth, ClothSolver) and cloth.contacts is not None:
            seen = cloth.contacts.rigid
            places, turns = (
                each.to_numpy().astype(np.float64) for each in (seen.colliding.position, seen.colliding.rotation)
            )
            found += list(zip(seen.geometries, places, turns, strict=False))
    return found


def depth_in(body: tuple[BodyGeometry, Points, Points], triangles: Points) -> float:
    """How deep triangles (k, 3, 3) are in a body, at the points `CUTS` [m]; 0 if none is."""
    geometry, place, turn = body
    relative = (triangles - place) @ turn
    low, high = geometry.bounds
    near = ((relative.max(axis=1) > low) & (relative.min(axis=1) < high)).all(axis=1)
    points = np.einsum("wk,tkx->twx", CUTS, relative[near]).reshape(-1, 3)
    points = points[((points > low) & (points < high)).all(axis=1)]
    return float(max(-geometry.signed_distance(points).min(), 0.0)) if len(points) else 0.0


def passes(before: Points, after: Points) -> int:
    """How often triangles (k, 3, 3) that move straight pass the origin, the middle of a body."""
    both = np.concatenate([before, after], axis=1)
    near = (both.min(axis=1) <= 0.0).all(axis=1) & (both.max(axis=1) >= 0.0).all(axis=1)
    count = 0
    for start, way in zip(before[near], (after - before)[near], strict=True):
        times = np.linspace(0.0, 1.0, 4)  # the volume of the tetrahedron with the origin is a cubic of time
        volume = [np.linalg.det(start + t * way) for t in times]
        for root in np.roots(np.polyfit(times, volume, 3)):
            if abs(root.imag) < 1e-9 and 0.0 <= root.real < 1.0:
                a, b, c = start + root.real * way
                normal = np.cross(b - a, c - a)
                sides = [float(np.dot(np.cross(p, q), normal)) for p, q in ((a, b), (b, c), (c, a))]
                count += min(sides) >= 0.0
    return int(count)


def find(_: str, *, nodes: int, share: float) -> Found:
    """All scenes: crossings, bodies that pass, and how deep cloth gets in them without a warning."""
    return judged([measure(name, nodes, share) for name in SCENES])


def judged(rows: Sequence[dict[str, Any]]) -> Found:
    """Checks and curves of what was measured."""
    checks: list[Check] = []
    series: dict[str, NDArray[np.float64]] = {}
    for row in rows:
        name = row["scene"]
        untold = [depth for depth, told in zip(row["depth_mm"], row["told"], strict=True) if not told]
        checks += [
            Check(f"edges through triangles, {name}, sum over frames", float(sum(row["crossings"])), 0.0, 0.0,
                  "required; exact arithmetic that shares no code with the solver"),
            Check(f"middles of bodies that cloth passes, {name}", float(sum(row["passed"])), 0.0, 0.0,
                  "required; after every substep"),
            Check(f"deepest that cloth is in a body without a warning, {name}", max(untold, default=0.0), 0.0, 0.5,
                  "its thickness; what is deeper is told", "mm"),
        ]  # fmt: skip
        series |= {f"{name}: {key}": value for key, value in row.items() if isinstance(value, list)}
    return checks, series


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Found numbers as a Markdown table."""
    lines = [
        "| scene | nodes | frames | crossings | passed | shows [mm] | most strain [%] | most substeps | "
        "processor time, median, worst ms | left, zoned, told |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        settled = row["ms"][3:] or row["ms"]  # the first ones compile
        lines.append(
            f"| {row['scene']} | {row['nodes']} | {row['frames']} | {sum(row['crossings'])} | {sum(row['passed'])} | "
            f"{max(row['depth_mm']):.2f} | {100 * max(row['strain']):.1f} | {max(row['substeps'])} | "
            f"{np.median(settled):.0f}, {max(settled):.0f} | "
            f"{sum(row['left']):.0f}, {sum(row['zoned']):.0f}, {sum(row['told']):.0f} |"
        )
    return "\n".join(lines)


def draw(results: Sequence[CaseResult]) -> Figure:
    """Depth of bodies, strain and substeps by frames."""
    figure, panels = make_panels(3)
    series = results[0].series
    for axes, (key, label) in zip(
        panels, (("depth_mm", "deepest [mm]"), ("strain", "strain [-]"), ("substeps", "substeps")), strict=True
    ):
        for number, name in enumerate(SCENES):
            values = series[f"{name}: {key}"]
            style, shade = divmod(number, len(SHADES))
            axes.plot(values, ("-", ":", "--")[style], color=SHADES[shade], linewidth=1.0, label=name)
        label_axes(axes, "frame", label, legend=False)
    panels[2].set_yscale("log")  # a pellet takes a hundred times as many
    figure.legend(handles=panels[0].get_lines(), loc="outside right center")
    return figure


CASE = Case(find, draw, solvers=("cloth",), sizes={"nodes": (32, 17), "share": (1.0, 0.4)})


def main() -> None:
    """Measure the scenes that the command line names."""
    from sim.core.runtime import initialize

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", default=[], help=f"of {', '.join(SCENES)}")
    parser.add_argument("--nodes", type=int, default=32, help="along a side (default: %(default)s)")
    parser.add_argument("--share", type=float, default=1.0, help="of the frames (default: %(default)s)")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    if unknown := set(arguments.scenes) - set(SCENES):
        parser.error(f"no scene {', '.join(sorted(unknown))}; there are {', '.join(SCENES)}")
    initialize(arguments.device)
    rows = []
    for name in arguments.scenes or SCENES:
        rows.append(measure(name, arguments.nodes, arguments.share))
        print(table_of(rows).splitlines()[-1], flush=True)
    print(f"\n{table_of(rows)}\n\n{json.dumps(rows)}")


if __name__ == "__main__":
    main()
