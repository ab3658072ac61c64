"""Bodies by kind: `DRAWERS` says of each kind what is kept of a body and how that is drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.table import material_of
from pipeline.model.looks import BODY, parts_of
from pipeline.store.cache import read_frame, read_smoke_density
from pipeline.web.drawing.canvas import Canvas, Rgb
from pipeline.web.drawing.colors import BODY as BODY_COLOR
from pipeline.web.drawing.colors import CLOTH, SURFACE, Colors, ramp, srgb
from pipeline.web.drawing.shapes import Body, Particles, Pose, Sheet, Smoke
from pipeline.web.drawing.smoke_pictures import cut, points

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.core.snapshots import Snapshot

MeshOf = Callable[[str, str], tuple[NDArray[Any], NDArray[Any]] | None]
"""Vertices [m] and faces of a part of a rigid body, by their names; None before they are made."""

PLAIN, SPEED, PRESSURE = "plain", "speed", "pressure"
"""Colourings of particles; the speed is computed from velocities, every other value is an array of the snapshot."""
POINTS, SLICE = "points", "slice"
DENSITY_AROUND = 0.03
"""Densities are coloured within so much of the one at rest, on both sides."""
PRESSURE_PERCENTILE = 99.0
"""Pressures have the last colour from this share of the particles on: where water hits, single ones peak."""


@dataclass(frozen=True)
class Range:
    """Values of the first and the last colour; `around` if the middle is neutral."""

    low: float
    high: float
    around: bool = False


@dataclass
class Extents:
    """Smallest and largest values that were seen, so that colours mean the same in every frame."""

    # of particles by the value's name, of a smoke's density by "smoke/" and its name
    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    top_speed: float = 0.0  # largest speed that the solvers told of any frame [m/s]; 0 if they did not

    def see(self, bodies: Mapping[str, Body]) -> None:
        """Take the bodies of a frame into account."""
        for body_name, body in bodies.items():
            for name, (low, high) in DRAWERS[body.kind].extents(body_name, body).items():
                least, most = self.values.get(name, (math.inf, -math.inf))
                self.values[name] = min(least, low), max(most, high)

    def range(self, name: str, cloud: Particles) -> Range:
        """The values of a cloud that have the first and the last colour."""
        if name == "density" and cloud.rest_density is not None:
            reach = DENSITY_AROUND * cloud.rest_density
            return Range(cloud.rest_density - reach, cloud.rest_density + reach, around=True)
        low, high = self.values.get(name, (0.0, 1.0))
        if name == PRESSURE:
            return Range(0.0, high)
        return Range(0.0, self.top_speed or high) if name == SPEED else Range(low, high)


@dataclass(frozen=True)
class Look:
    """Settings of a picture."""

    color_by: str = PLAIN  # values that colour particles, by their name, or `PLAIN`
    smoke_as: str = POINTS  # `POINTS` or `SLICE`
    slice_axis: str = "y"  # "x", "y" or "z"
    slice_share: float = 0.5  # place in the smoke's box, 0 to 1


@dataclass(frozen=True)
class Setting:
    """All that drawers need besides a body: its job, the meshes of rigid bodies, the look, and the extents so far."""

    job: Job
    mesh: MeshOf
    look: Look = field(default_factory=Look)
    extents: Extents = field(default_factory=Extents)


@dataclass(frozen=True)
class BodyDrawer:
    """Rules for the bodies of one kind."""

    layer: str  # name of the box that shows and hides them
    of: Callable[[Snapshot, int], Body]  # a body of a snapshot; of particles, at most so many
    draw: Callable[[Canvas, str, Any, Setting], None]  # draws a body of a name as things `/KIND/NAME...`
    # smallest and largest values of a body that colours depend on, see `Extents`
    extents: Callable[[str, Any], dict[str, tuple[float, float]]] = lambda _name, _body: {}
    # reads a body from a cached frame, where the whole snapshot would be too much
    read: Callable[[Path, str], Body] | None = None


def particles_of(snapshot: Snapshot, most: int) -> Particles:
    """The particles; of more than `most`, every second, third, ... by number: the same ones in every frame."""
    position = np.asarray(snapshot.arrays["position"], np.float32)
    count = len(position)
    step = every(count, most)
    chosen: Any = slice(None, None, step)
    if step > 1 and "particle_id" in snapshot.arrays:
        chosen = np.asarray(snapshot.arrays["particle_id"], np.int64) % step == 0
    values = {
        name: own(np.asarray(array[chosen], np.float32))
        for name, array in snapshot.arrays.items()
        if array.shape == (count,) and np.issubdtype(array.dtype, np.floating)
    }
    if "velocity" in snapshot.arrays:
        velocity = np.asarray(snapshot.arrays["velocity"], np.float32)[chosen]
        values[SPEED] = np.linalg.norm(velocity, axis=1).astype(np.float32)
    rest_density = snapshot.number("rest_density") if "rest_density" in snapshot.attributes else None
    return Particles(own(position[chosen]), values, snapshot.number("particle_radius"), rest_density, count)


def _extents_of_particles(_name: str, cloud: Particles) -> dict[str, tuple[float, float]]:
    found = {}
    for key, values in cloud.values.items():
        finite = values[np.isfinite(values)]
        if len(finite):
            top = np.percentile(finite, PRESSURE_PERCENTILE) if key == PRESSURE else finite.max()
            found[key] = float(finite.min()), float(top)
    return found


def _draw_particles(canvas: Canvas, name: str, cloud: Particles, setting: Setting) -> None:
    """Round particles; those that have no such values in one colour."""
    colors: Colors | Rgb
    values = cloud.values.get(setting.look.color_by)
    if values is None:
        colors = color_of(setting.job, name, BODY, SURFACE)
    else:
        span = setting.extents.range(setting.look.color_by, cloud)
        colors = ramp(values, span.low, span.high, around=span.around)
    canvas.points(f"/fluid/{name}", cloud.position, colors, radius=cloud.radius)


def _pose_of(snapshot: Snapshot, _most: int) -> Pose:
    return Pose(*(np.asarray(snapshot.arrays[key], np.float64) for key in ("position", "orientation")))


def _draw_parts(canvas: Canvas, name: str, pose: Pose, setting: Setting) -> None:
    """All parts of a rigid body whose meshes are there."""
    parameters = next((each for each in setting.job.rigid if each.name == name), None)
    for part in () if parameters is None else parts_of(parameters.shape.type):
        mesh = setting.mesh(name, part)
        if mesh is not None:
            color, path = color_of(setting.job, name, part, BODY_COLOR), f"/rigid/{name}/{part}"
            canvas.mesh(path, *mesh, color, position=pose.position, orientation=pose.orientation)


def _sheet_of(snapshot: Snapshot, _most: int) -> Sheet:
    arrays = snapshot.arrays
    return Sheet(np.asarray(arrays["position"], np.float32), np.asarray(arrays["triangles"], np.int32))


def _draw_sheet(canvas: Canvas, name: str, sheet: Sheet, setting: Setting) -> None:
    color = color_of(setting.job, name, BODY, CLOTH)
    canvas.mesh(f"/cloth/{name}", sheet.position, sheet.triangles, color, two_sided=True)


def _smoke_of(snapshot: Snapshot, _most: int) -> Smoke:
    x, y, z = snapshot.vector("origin")
    return Smoke(np.asarray(snapshot.arrays["density"], np.float32), (x, y, z), snapshot.number("cell_size"))


def _extents_of_smoke(name: str, smoke: Smoke) -> dict[str, tuple[float, float]]:
    return {f"smoke/{name}": (0.0, float(smoke.density.max()))} if smoke.density.size else {}


def _draw_smoke(canvas: Canvas, name: str, smoke: Smoke, setting: Setting) -> None:
    """Points, a cell each, or a slice."""
    parameters = next((each for each in setting.job.smoke if each.name == name), None)
    if parameters is None:
        return
    look, (_, densest) = setting.look, setting.extents.values.get(f"smoke/{name}", (0.0, 0.0))
    if look.smoke_as == SLICE:
        box = parameters.corners(setting.job.domain)
        across = cut(smoke, axis=look.slice_axis, share=look.slice_share, box=box, densest=densest)
        if across is not None:
            canvas.slice(f"/smoke/{name}", across)
    else:
        cells = points(smoke, densest=densest)
        canvas.points(f"/smoke/{name}", cells.position, cells.colors, radius=0.4 * smoke.cell_size)


DRAWERS: Mapping[str, BodyDrawer] = {
    "fluid": BodyDrawer("Particles", particles_of, _draw_particles, _extents_of_particles),
    "cloth": BodyDrawer("Cloth", _sheet_of, _draw_sheet),
    "rigid": BodyDrawer("Rigid bodies", _pose_of, _draw_parts),
    "smoke": BodyDrawer(
        "Smoke", _smoke_of, _draw_smoke, _extents_of_smoke, lambda path, name: Smoke(*read_smoke_density(path, name))
    ),
}
"""Drawers by kind of body."""


def read_bodies(path: Path, kinds: Mapping[str, str], most: int) -> dict[str, Body]:
    """All bodies of a cached frame, whose kinds are given by name; of particles, at most so many."""
    found: dict[str, Body] = {}
    for kind, drawer in DRAWERS.items():
        names = [name for name, of in kinds.items() if of == kind]
        if drawer.read is not None:
            found |= {name: drawer.read(path, name) for name in names}
        elif names:
            snapshots = read_frame(path, kind=kind).bodies
            found |= {name: drawer.of(snapshot, most) for name, snapshot in snapshots.items()}
    return found


def draw_bodies(
    canvas: Canvas, bodies: Mapping[str, Body], setting: Setting, *, layers: Collection[str] | None = None
) -> None:
    """Draw bodies, by name; only those of some layers if these are given."""
    for name, body in bodies.items():
        drawer = DRAWERS[body.kind]
        if layers is None or drawer.layer in layers:
            drawer.draw(canvas, name, body, setting)


def color_of(job: Job, body: str, part: str, usual: Rgb) -> Rgb:
    """The colour that the job gives a body, else the usual one, which tells kinds of bodies apart."""
    color = material_of(job, body, part).color
    return usual if color is None else srgb(color)


def every(count: int, most: int) -> int:
    """1 if so many particles may all be shown, else the step: every second, third, ..."""
    return max(1, -(-count // max(1, most)))


def own(array: NDArray[Any]) -> NDArray[Any]:
    """An array that keeps no larger one in memory."""
    base = array.base
    return array if base is None or (isinstance(base, np.ndarray) and base.nbytes == array.nbytes) else array.copy()
