"""A job's cached frames on the canvas: bodies, and around them surfaces, drops, whitewater, pins, domain, camera."""

import numpy as np

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.rigid import is_animated
from pipeline.kinds.table import KINDS
from pipeline.model.job import Job
from pipeline.model.looks import BODY, parts_of
from pipeline.web.drawing.bodies import Extents, Look, Mesh, Setting, color_of, draw_bodies, meshes_at_rest
from pipeline.web.drawing.canvas import Canvas, box_edges
from pipeline.web.drawing.colors import PIN, SURFACE, WHITEWATER
from pipeline.web.drawing.shapes import Pose
from pipeline.web.pins import JobPin, pins_of_job
from pipeline.web.viewer.committed import CommittedFrames, Stamp
from pipeline.web.viewer.frames import ShownFrame
from render.errors import InvalidFileError
from render.meshes import read_ply
from sim.core.motion.rotation import from_degrees

DOMAIN_COLOR, CAMERA_COLOR = (120, 130, 146), (240, 190, 90)
SURFACES, DROPS, SPRAY, DOMAIN, PINS, CAMERA = "Surfaces", "Drops", "Whitewater", "Domain", "Pins", "Camera"
"""Layers beside those of the kinds of bodies."""


class JobScene:
    """Frames of a job on a canvas; its folder is only read."""

    def __init__(self, job: Job, layout: JobLayout, committed: CommittedFrames) -> None:
        self._job, self._layout, self._committed = job, layout, committed
        self._meshes: dict[ArtifactPath, tuple[Stamp, Mesh]] = {}
        self._built, self._unbuilt = self._build()
        self._standing = {
            body.name: Pose("rigid", np.array(body.position), from_degrees(body.rotation_deg))
            for body in job.rigid
            if body.kind == "static"
        }
        self._pins: list[JobPin] | None = None
        self.troubles: list[str] = []
        width, height = job.render.resolution
        self._aspect = width / height
        self._size = float(np.linalg.norm(np.subtract(job.domain.max, job.domain.min)))

    @property
    def layers(self) -> list[str]:
        """Layers that this job has."""
        job = self._job
        has = {
            **{kind.display.layer: kind.bodies(job) for kind in KINDS.values()},
            SURFACES: job.fluid,
            DROPS: job.fluid and job.surface.drops_per_particle,
            SPRAY: job.whitewater,
            DOMAIN: True,
            PINS: any(cloth.pin for cloth in job.cloth),
            CAMERA: True,
        }
        return [layer for layer, there in has.items() if there]

    def draw(self, canvas: Canvas, frame: ShownFrame | None, look: Look, extents: Extents) -> None:
        """Draw a frame; None: only what stays the same."""
        self.troubles = [*self._unbuilt]
        job, layers = self._job, look.layers
        bodies = {**({} if frame is None else frame.bodies), **self._standing}
        with canvas.picture():
            if DOMAIN in layers:
                canvas.lines("/domain", box_edges(job.domain.min, job.domain.max), DOMAIN_COLOR)
            draw_bodies(canvas, bodies, Setting(job, self._mesh, look, extents))
            if frame is None:
                return
            if SURFACES in layers:
                for name, mesh in frame.surfaces.items():
                    opacity = 0.45 if KINDS["fluid"].display.layer in layers else None
                    color = color_of(job, name, BODY, SURFACE)
                    canvas.mesh(f"/surface/{name}", mesh.vertices, mesh.faces, color, opacity=opacity)
            if DROPS in layers:
                for name, cloud in frame.drops.items():
                    color = color_of(job, name, BODY, SURFACE)
                    canvas.points(f"/drops/{name}", cloud.position, color, radius=cloud.radius)
            if SPRAY in layers:
                for name, cloud in frame.whitewater.items():
                    canvas.points(f"/whitewater/{name}", cloud.position, WHITEWATER, radius=cloud.radius)
            if PINS in layers:
                self._draw_pins(canvas, frame)
            if CAMERA in layers and frame.view is not None:
                canvas.camera("/camera", frame.view, aspect=self._aspect, size=self._size / 10.0, color=CAMERA_COLOR)

    def _build(self) -> tuple[dict[tuple[str, str], Mesh], list[str]]:
        """Meshes of bodies of which there are no files (yet), as after `--until surface`; and what failed of that."""
        built: dict[tuple[str, str], Mesh] = {}
        failed: list[str] = []
        for body in self._job.rigid:
            if not body.is_own_model or is_animated(body):
                continue
            files = [self._layout.body_mesh(body.name, part) for part in parts_of(body.shape)]
            try:
                built |= {} if all(map(self._committed.is_there, files)) else meshes_at_rest(body)
            except (ValueError, OSError) as error:
                failed.append(f"{body.group} is not shown: {error}")
        return built, failed

    def _mesh(self, body: str, part: str) -> Mesh | None:
        """The mesh of a part of a body that is its own; None if it cannot be made or read."""
        artifact = self._layout.body_mesh(body, part)
        stamp = self._committed.stamp([artifact])
        kept = self._meshes.get(artifact)
        if kept is not None and kept[0] == stamp:
            return kept[1]
        self._meshes.pop(artifact, None)
        if not self._committed.is_there(artifact):
            return self._built.get((body, part))
        try:
            mesh = read_ply(self._layout.path(artifact))
        except (InvalidFileError, OSError) as error:
            self.troubles.append(f"{error}; see: pipeline verify")
            return None
        self._meshes[artifact] = stamp, (mesh.vertices, mesh.faces)
        return mesh.vertices, mesh.faces

    def _draw_pins(self, canvas: Canvas, frame: ShownFrame) -> None:
        try:
            if self._pins is None:
                self._pins = pins_of_job(self._job)
        except (ValueError, OSError) as error:  # the mesh of a cloth is gone or damaged
            self.troubles.append(f"pins are not shown: {error}")
            return
        for name in dict.fromkeys(pin.cloth for pin in self._pins):
            position = getattr(frame.bodies.get(name), "position", None)
            held = [pin.nodes for pin in self._pins if pin.cloth == name and pin.holds(frame.numbers.time_s)]
            if position is not None and held:
                nodes = np.unique(np.concatenate(held))
                if nodes[-1] >= len(position):  # the frame is of an earlier version of the job
                    self.troubles.append(f"pins of {name} are not shown: this frame has fewer nodes than the job")
                    continue
                canvas.points(f"/pin/{name}", position[nodes], PIN, radius=self._size / 250.0)
