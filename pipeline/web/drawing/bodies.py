"""Bodies by form: `DRAWERS` says of each form what is kept of a body and how that is drawn."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.table import KINDS, material_of
from pipeline.kinds.table import bodies as bodies_of
from pipeline.model.job import Job
from pipeline.model.looks import BODY, parts_of
from pipeline.store.cache import read_frame, read_smoke_density
from pipeline.web.drawing.canvas import Canvas, Rgb
from pipeline.web.drawing.colors import BODY as BODY_COLOR
from pipeline.web.drawing.colors import CLOTH, SURFACE, Colors, ramp, srgb
from pipeline.web.drawing.shapes import Body, Particles, Pose, Sheet, Smoke
from pipeline.web.drawing.smoke_pictures import cut, points
from sim.core.snapshots import Snapshot
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.placement import build_solid

Mesh = tuple[NDArray[Any], NDArray[Any]]
"""Vertices [m] and faces."""
MeshOf = Callable[[str, str], Mesh | None]
"""The mesh of a part of a body, by their names; None where there is none."""

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

    # of points by the value's name, of cells by "density of " and the body's name
    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    top_speed: float = 0.0  # largest speed that the solvers told of any frame [m/s]; 0 if they did not

    def see(self, bodies: Mapping[str, Body]) -> None:
        """Take the bodies of a frame into account."""
        for body_name, body in bodies.items():
            for name, (low, high) in _drawer_of(body.kind).extents(body_name, body).items():
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

    layers: frozenset[str] = frozenset()  # that are shown; of bodies by `pipeline.kinds.base.Display`
    color_by: str = PLAIN  # values that colour particles, by their name, or `PLAIN`
    smoke_as: str = POINTS  # `POINTS` or `SLICE`
    slice_axis: str = "y"  # "x", "y" or "z"
    slice_share: float = 0.5  # place in the smoke's box, 0 to 1


def meshes_at_rest(body: RigidBodyParameters) -> dict[tuple[str, str], Mesh]:
    """Meshes of the parts of a rigid body, built as its stage builds them, by the names of body and part.

    Raises ValueError, OSError: the file of its shape is damaged or gone.
    """
    mesh = build_solid(body).rest_mesh()
    pieces = {part: mesh.piece(part) for part in parts_of(body.shape)}
    return {
        (body.name, part): (piece.vertices.astype(np.float32), piece.faces.astype(np.uint32))
        for part, piece in pieces.items()
    }


@dataclass(frozen=True)
class Setting:
    """All that is needed besides a body to draw it: its job, the meshes of parts, the look, and the extents so far."""

    job: Job
    mesh: MeshOf
    look: Look = field(default_factory=Look)
    extents: Extents = field(default_factory=Extents)

    def parameters(self, body: Body, name: str) -> Any:
        """What the job says of a body; None if it has no such body."""
        return self._by_name.get((body.kind, name))

    @cached_property
    def _by_name(self) -> dict[tuple[str, str], Any]:
        return {(kind.name, body.name): body for _, kind, body in bodies_of(self.job)}


@dataclass(frozen=True)
class Drawer:
    """Rules for the bodies of one form (`pipeline.kinds.base.Display`)."""

    of: Callable[[Snapshot, int], Body]  # a body of a snapshot; of points, at most so many
    draw: Callable[[Canvas, str, Any, Setting], None]  # draws a body of a name as things `/KIND/NAME...`
    # smallest and largest values of a body that colours depend on, see `Extents`
    extents: Callable[[str, Any], dict[str, tuple[float, float]]] = lambda _name, _body: {}


# --- points ---


def _particles_of(snapshot: Snapshot, most: int) -> Particles:
    """The points; of more than `most`, every second, third, ... by number: the same ones in every frame."""
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
    radius = snapshot.number(KINDS[snapshot.kind].display.radius)
    return Particles(snapshot.kind, own(position[chosen]), values, radius, rest_density, count)


def _extents_of_particles(_name: str, cloud: Particles) -> dict[str, tuple[float, float]]:
    found = {}
    for key, values in cloud.values.items():
        finite = values[np.isfinite(values)]
        if len(finite):
            top = np.percentile(finite, PRESSURE_PERCENTILE) if key == PRESSURE else finite.max()
            found[key] = float(finite.min()), float(top)
    return found


def _draw_particles(canvas: Canvas, name: str, cloud: Particles, setting: Setting) -> None:
    """Round points; those that have no such values in one colour."""
    colors: Colors | Rgb
    values = cloud.values.get(setting.look.color_by)
    if values is None:
        colors = color_of(setting.job, name, BODY, SURFACE)
    else:
        span = setting.extents.range(setting.look.color_by, cloud)
        colors = ramp(values, span.low, span.high, around=span.around)
    canvas.points(f"/{cloud.kind}/{name}", cloud.position, colors, radius=cloud.radius)


# --- meshes and parts ---


def _sheet_of(snapshot: Snapshot, _most: int) -> Sheet:
    arrays = snapshot.arrays
    position, triangles = np.asarray(arrays["position"], np.float32), np.asarray(arrays["triangles"], np.int32)
    return Sheet(snapshot.kind, position, triangles)


def _draw_sheet(canvas: Canvas, name: str, sheet: Sheet, setting: Setting) -> None:
    color = color_of(setting.job, name, BODY, CLOTH)
    canvas.mesh(f"/{sheet.kind}/{name}", sheet.position, sheet.triangles, color, two_sided=True)


def _pose_of(snapshot: Snapshot, _most: int) -> Pose | Sheet:
    """The pose of a body, or the mesh of one that a file animates."""
    if "vertices" in snapshot.arrays:
        vertices, triangles = snapshot.arrays["vertices"], snapshot.arrays["triangles"]
        return Sheet(snapshot.kind, np.asarray(vertices, np.float32), np.asarray(triangles, np.int32))
    position, orientation = (np.asarray(snapshot.arrays[key], np.float64) for key in ("position", "orientation"))
    return Pose(snapshot.kind, position, orientation)


def _draw_parts(canvas: Canvas, name: str, pose: Pose | Sheet, setting: Setting) -> None:
    """All parts of a body whose meshes are there."""
    if isinstance(pose, Sheet):
        color = color_of(setting.job, name, BODY, BODY_COLOR)
        canvas.mesh(f"/{pose.kind}/{name}/{BODY}", pose.position, pose.triangles, color)
        return
    parameters = setting.parameters(pose, name)
    for part in () if parameters is None else parts_of(parameters.shape):
        mesh = setting.mesh(parameters.model, part)
        if mesh is not None:
            color, path = color_of(setting.job, name, part, BODY_COLOR), f"/{pose.kind}/{name}/{part}"
            canvas.mesh(path, *mesh, color, position=pose.position, orientation=pose.orientation)


# --- density ---


def _smoke_of(snapshot: Snapshot, _most: int) -> Smoke:
    x, y, z = snapshot.vector("origin")
    density = np.asarray(snapshot.arrays["density"], np.float32)
    return Smoke(snapshot.kind, density, (x, y, z), snapshot.number("cell_size"))


def _extents_of_smoke(name: str, smoke: Smoke) -> dict[str, tuple[float, float]]:
    return {f"density of {name}": (0.0, float(smoke.density.max()))} if smoke.density.size else {}


def _draw_smoke(canvas: Canvas, name: str, smoke: Smoke, setting: Setting) -> None:
    """Points, a cell each, or a slice."""
    parameters = setting.parameters(smoke, name)
    if parameters is None:
        return
    look, path = setting.look, f"/{smoke.kind}/{name}"
    _, densest = setting.extents.values.get(f"density of {name}", (0.0, 0.0))
    if look.smoke_as == SLICE:
        box = parameters.corners(setting.job.domain)
        across = cut(smoke, axis=look.slice_axis, share=look.slice_share, box=box, densest=densest)
        if across is not None:
            canvas.slice(path, across)
    else:
        cells = points(smoke, densest=densest)
        canvas.points(path, cells.position, cells.colors, radius=0.4 * smoke.cell_size)


DRAWERS: Mapping[str, Drawer] = {
    "points": Drawer(_particles_of, _draw_particles, _extents_of_particles),
    "mesh": Drawer(_sheet_of, _draw_sheet),
    "parts": Drawer(_pose_of, _draw_parts),
    "density": Drawer(_smoke_of, _draw_smoke, _extents_of_smoke),
}
"""Drawers by form."""


def _drawer_of(kind: str) -> Drawer:
    return DRAWERS[KINDS[kind].display.form]


# --- bodies of any kind ---


def body_of(snapshot: Snapshot, most: int) -> Body:
    """A body of a snapshot; of points, at most so many."""
    return _drawer_of(snapshot.kind).of(snapshot, most)


def read_bodies(path: Path, kinds: Mapping[str, str], most: int) -> dict[str, Body]:
    """All bodies of a cached frame, whose kinds are given by name; of points, at most so many."""
    found: dict[str, Body] = {}
    for kind in dict.fromkeys(kind for kind in kinds.values() if kind in KINDS):
        if KINDS[kind].display.form == "density":  # whose other grids would be too much
            names = [name for name, of in kinds.items() if of == kind]
            found |= {name: Smoke(kind, *read_smoke_density(path, name)) for name in names}
        else:
            found |= {name: body_of(snapshot, most) for name, snapshot in read_frame(path, kind=kind).bodies.items()}
    return found


def draw_bodies(canvas: Canvas, bodies: Mapping[str, Body], setting: Setting) -> None:
    """Draw those of some bodies, by name, whose layers are shown."""
    for name, body in bodies.items():
        if KINDS[body.kind].display.layer in setting.look.layers:
            _drawer_of(body.kind).draw(canvas, name, body, setting)


def has_form(job: Job, form: str) -> bool:
    """Whether a job has bodies of a form."""
    return any(kind.display.form == form and kind.bodies(job) for kind in KINDS.values())


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
