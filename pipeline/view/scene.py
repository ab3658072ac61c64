"""From a frame of a job to the things that are drawn of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.job.looks import BODY, parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.task import ArtifactPath
from pipeline.view.colors import BODY as BODY_COLOR
from pipeline.view.colors import CLOTH, PIN, SURFACE, WHITEWATER, Colors, ramp, srgb
from pipeline.view.committed import CommittedFrames, Stamp
from pipeline.view.drawing import Drawing, Rgb, box_edges
from pipeline.view.frames import PRESSURE, SPEED, Particles, Pose, ShownFrame
from pipeline.view.smoke_pictures import cut, points
from render.errors import InvalidFileError
from render.meshes import SurfaceMesh, read_ply
from sim.rigid.rotation import from_degrees

PLAIN = "plain"
DENSITY_AROUND = 0.03
"""Densities are coloured within so much of the one at rest, on both sides."""
PRESSURE_PERCENTILE = 99.0
"""The last colour of pressures is what all but one of a hundred have at most: where water hits, single ones peak."""
DOMAIN_COLOR, CAMERA_COLOR = (120, 130, 146), (240, 190, 90)
PARTICLES, SURFACES, SPRAY, CLOTHS, BODIES, SMOKE, DOMAIN, PINS, CAMERA = (
    "Particles", "Surfaces", "Whitewater", "Cloth", "Rigid bodies", "Smoke", "Domain", "Pins", "Camera",
)  # fmt: skip
"""Kinds of things that can be hidden."""
POINTS, SLICE = "points", "slice"


@dataclass(frozen=True)
class Shown:
    """What is to be seen of a frame.

    Attributes:
        layers: kinds of things.
        color_by: what particles are coloured by: a name of their values, or `PLAIN`.
        smoke_as: `POINTS` or `SLICE`.
        slice_axis: "x", "y" or "z".
        slice_share: where in the smoke's box, 0 to 1.
    """

    layers: frozenset[str]
    color_by: str = SPEED
    smoke_as: str = POINTS
    slice_axis: str = "y"
    slice_share: float = 0.5


@dataclass(frozen=True)
class Range:
    """Values of the first and the last colour; `around` if the middle is neutral."""

    low: float
    high: float
    around: bool = False


@dataclass
class Extents:
    """Largest values that were seen, so that colours mean the same in every frame.

    Attributes:
        values: by what particles are coloured by.
        smoke: largest density of a smoke, by its name.
    """

    values: dict[str, tuple[float, float]] = field(default_factory=dict)
    smoke: dict[str, float] = field(default_factory=dict)

    def see(self, shown: ShownFrame) -> None:
        """Take a frame into account."""
        for cloud in shown.fluids.values():
            for name, values in cloud.values.items():
                finite = values[np.isfinite(values)]
                if len(finite):
                    low, high = self.values.get(name, (math.inf, -math.inf))
                    top = np.percentile(finite, PRESSURE_PERCENTILE) if name == PRESSURE else finite.max()
                    self.values[name] = (min(low, float(finite.min())), max(high, float(top)))
        for name, smoke in shown.smokes.items():
            if smoke.density.size:
                self.smoke[name] = max(self.smoke.get(name, 0.0), float(smoke.density.max()))

    def range(self, name: str, cloud: Particles, *, top_speed: float) -> Range:
        """Which values have the first and the last colour.

        Args:
            name: of the values.
            cloud: whose.
            top_speed: largest speed that the solvers told of any frame [m/s]; 0 if they did not.
        """
        if name == "density" and cloud.rest_density is not None:
            reach = DENSITY_AROUND * cloud.rest_density
            return Range(cloud.rest_density - reach, cloud.rest_density + reach, around=True)
        low, high = self.values.get(name, (0.0, 1.0))
        if name == PRESSURE:
            return Range(0.0, high)
        return Range(0.0, top_speed or high) if name == SPEED else Range(low, high)


class JobScene:
    """Draws frames of a job.

    Args:
        job: the job.
        layout: its folder, which is only read.
        committed: tells which files of it may be read.
    """

    def __init__(self, job: Job, layout: JobLayout, committed: CommittedFrames) -> None:
        self._job, self._layout, self._committed = job, layout, committed
        self._meshes: dict[ArtifactPath, tuple[Stamp, SurfaceMesh]] = {}
        self._standing = {
            body.name: Pose(np.array(body.position), from_degrees(body.rotation_deg))
            for body in job.rigid
            if body.kind == "static"
        }
        self._pinned: dict[str, list[tuple[NDArray[np.int64], float]]] | None = None
        self.troubles: list[str] = []
        width, height = job.render.resolution
        self._aspect = width / height
        self._size = float(np.linalg.norm(np.subtract(job.domain.max, job.domain.min)))

    @property
    def layers(self) -> list[str]:
        """Kinds of things that this job has."""
        job = self._job
        has = {
            PARTICLES: job.fluid,
            SURFACES: job.fluid,
            SPRAY: job.whitewater,
            CLOTHS: job.cloth,
            BODIES: job.rigid,
            SMOKE: job.smoke,
            DOMAIN: True,
            PINS: any(cloth.pin for cloth in job.cloth),
            CAMERA: True,
        }
        return [layer for layer, there in has.items() if there]

    def draw(
        self, drawing: Drawing, frame: ShownFrame | None, shown: Shown, extents: Extents, *, top_speed: float
    ) -> None:
        """Draw a frame; None: only what stays the same."""
        self.troubles = []
        with drawing.picture():
            if DOMAIN in shown.layers:
                edges = box_edges(self._job.domain.min, self._job.domain.max)
                drawing.lines("/domain", edges, DOMAIN_COLOR)
            if BODIES in shown.layers:
                self._draw_bodies(drawing, frame.poses if frame is not None else {})
            if frame is None:
                return
            self._draw_fluids(drawing, frame, shown, extents, top_speed=top_speed)
            if CLOTHS in shown.layers:
                for name, sheet in frame.cloths.items():
                    color = color_of(self._job, name, BODY, CLOTH)
                    drawing.mesh(f"/cloths/{name}", sheet.position, sheet.triangles, color, two_sided=True)
            if PINS in shown.layers:
                self._draw_pins(drawing, frame)
            if SMOKE in shown.layers:
                self._draw_smoke(drawing, frame, shown, extents)
            if CAMERA in shown.layers and frame.view is not None:
                drawing.camera("/camera", frame.view, aspect=self._aspect, size=self._size / 10.0, color=CAMERA_COLOR)

    def _draw_fluids(
        self, drawing: Drawing, frame: ShownFrame, shown: Shown, extents: Extents, *, top_speed: float
    ) -> None:
        if PARTICLES in shown.layers:
            for name, cloud in frame.fluids.items():
                colors = particle_colors(cloud, shown.color_by, extents, top_speed=top_speed)
                drawing.points(f"/fluids/{name}", cloud.position, colors, radius=cloud.radius)
        if SURFACES in shown.layers:
            for name, mesh in frame.surfaces.items():
                opacity = 0.45 if PARTICLES in shown.layers else None
                color = color_of(self._job, name, BODY, SURFACE)
                drawing.mesh(f"/surfaces/{name}", mesh.vertices, mesh.faces, color, opacity=opacity)
        if SPRAY in shown.layers:
            for name, cloud in frame.whitewater.items():
                drawing.points(f"/whitewater/{name}", cloud.position, WHITEWATER, radius=cloud.radius)

    def _draw_bodies(self, drawing: Drawing, poses: Mapping[str, Pose]) -> None:
        for body in self._job.rigid:
            if body.kind == "static":
                pose = self._standing[body.name]
            elif body.name in poses:
                pose = poses[body.name]
            else:
                continue
            for part in parts_of(body.shape.type):
                name = body.name if part == BODY else f"{body.name}.{part}"
                mesh = self._mesh(body.name, part)
                if mesh is not None:
                    drawing.mesh(
                        f"/bodies/{name}",
                        mesh.vertices,
                        mesh.faces,
                        color_of(self._job, body.name, part, BODY_COLOR),
                        position=pose.position,
                        orientation=pose.orientation,
                    )

    def _mesh(self, body: str, part: str) -> SurfaceMesh | None:
        """The mesh of a part of a body; None before it is made."""
        artifact = self._layout.body_mesh(body, part)
        stamp = self._committed.stamp([artifact])
        kept = self._meshes.get(artifact)
        if kept is not None and kept[0] == stamp:
            return kept[1]
        self._meshes.pop(artifact, None)
        if not self._committed.is_there(artifact):
            return None
        try:
            mesh = read_ply(self._layout.path(artifact))
        except (InvalidFileError, OSError) as error:
            self.troubles.append(f"{error}; see: pipeline verify")
            return None
        self._meshes[artifact] = stamp, mesh
        return mesh

    def _draw_pins(self, drawing: Drawing, frame: ShownFrame) -> None:
        try:
            pinned = self._pins()
        except (ValueError, OSError) as error:  # the mesh of a cloth is gone or damaged
            self.troubles.append(f"pins are not shown: {error}")
            return
        for name, pins in pinned.items():
            sheet = frame.cloths.get(name)
            held = [nodes for nodes, release_s in pins if frame.numbers.time_s < release_s]
            if sheet is not None and held:
                nodes = np.unique(np.concatenate(held))
                if nodes[-1] >= len(sheet.position):  # the frame is of an earlier version of the job
                    self.troubles.append(f"pins of {name} are not shown: this frame has fewer nodes than the job")
                    continue
                drawing.points(f"/pins/{name}", sheet.position[nodes], PIN, radius=self._size / 250.0)

    def _pins(self) -> dict[str, list[tuple[NDArray[np.int64], float]]]:
        """Nodes that are pinned, and until when [s], by cloth: found anew from the job, as the simulation does."""
        if self._pinned is None:
            from sim.cloth.start import pins_of

            self._pinned = {
                cloth.name: [
                    (nodes, math.inf if pin.release_s is None else pin.release_s)
                    for pin, nodes in zip(cloth.pin, pins_of(cloth), strict=True)
                ]
                for cloth in self._job.cloth
                if cloth.pin
            }
        return self._pinned

    def _draw_smoke(self, drawing: Drawing, frame: ShownFrame, shown: Shown, extents: Extents) -> None:
        for parameters in self._job.smoke:
            smoke = frame.smokes.get(parameters.name)
            if smoke is None:
                continue
            densest = extents.smoke.get(parameters.name, 0.0)
            if shown.smoke_as == SLICE:
                box = parameters.corners(self._job.domain)
                across = cut(smoke, axis=shown.slice_axis, share=shown.slice_share, box=box, densest=densest)
                if across is not None:
                    drawing.slice(f"/smoke/{parameters.name}", across)
            else:
                cells = points(smoke, densest=densest)
                radius = 0.4 * smoke.cell_size
                drawing.points(f"/smoke/{parameters.name}", cells.position, cells.colors, radius=radius)


def color_of(job: Job, body: str, part: str, otherwise: Rgb) -> Rgb:
    """The colour that the job gives a body, else one that tells kinds of bodies apart."""
    color = job.material_of(body, part).color
    return otherwise if color is None else srgb(color)


def particle_colors(cloud: Particles, color_by: str, extents: Extents, *, top_speed: float) -> Colors | Rgb:
    """Colours of particles; of those that have no such values, one."""
    values = cloud.values.get(color_by)
    if values is None:
        return SURFACE
    span = extents.range(color_by, cloud, top_speed=top_speed)
    return ramp(values, span.low, span.high, around=span.around)
