"""What a scene looks like on the page, and what of it can be dragged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from pipeline.job.looks import BODY, parts_of
from pipeline.job.models import Job
from pipeline.view.colors import BODY as BODY_COLOR
from pipeline.view.colors import CLOTH, PIN, SURFACE
from pipeline.view.drawing import Drawing, Rgb
from pipeline.view.scene import color_of
from render.parameters import CameraParameters
from sim.rigid.static import StaticBody
from sim.snapshots import Snapshot

Drag = Callable[[str, str, Any], None]
"""Called with the kind of the thing, its name and viser's event."""

FLOOR_COLOR: Rgb = (170, 176, 184)

PIN_SHARE = 0.012
"""Radius of a pin's handle, in diagonals of what is there."""


class SceneDrawing:
    """The bodies of a job in the scene of a viser server.

    Args:
        server: what pages connect to.
        job: as it is simulated.
        of_film: the placed camera of the job as it was read: bodies that rest there stand still no more in `job`.
        on_drag: is called when bodies that move, cloths and pins are dragged.
    """

    def __init__(self, server: viser.ViserServer, job: Job, of_film: CameraParameters, on_drag: Drag) -> None:
        from trimesh.creation import icosphere

        self._job, self._on_drag = job, on_drag
        self._drawing = Drawing(server, when_new=self._make_draggable)
        low, high = np.asarray(job.domain.min), np.asarray(job.domain.max)
        middle, size = (low + high) / 2.0, float(np.linalg.norm(high - low))
        if "z-" not in job.domain.open_faces:
            width, depth = (float(each) for each in (high - low)[:2])
            place = (float(middle[0]), float(middle[1]), float(low[2]) - 1e-3)
            server.scene.add_grid(
                "/floor", width=width, height=depth, plane="xy", cell_size=0.1, section_size=0.5, position=place,
                    cell_color=FLOOR_COLOR, section_color=FLOOR_COLOR,
            )  # fmt: skip
        camera = server.initial_camera
        if of_film.position is not None and not isinstance(of_film.look_at, str):
            camera.position = np.asarray(of_film.position)
            camera.look_at = middle if of_film.look_at is None else np.asarray(of_film.look_at)
        else:
            camera.position, camera.look_at = middle + size * np.array([0.35, -0.8, 0.35]), middle
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = float(np.radians(45.0))
        self._ball = icosphere(subdivisions=2, radius=PIN_SHARE * size)
        self._pieces = []
        for body in job.rigid:
            mesh = StaticBody(body).rest_mesh()
            for part in parts_of(body.shape.type):
                piece = mesh.piece(part)
                self._pieces.append((body.name, part, piece.vertices.astype(np.float32), piece.faces.astype(np.uint32)))

    def show(self, bodies: Mapping[str, Snapshot], pins: Mapping[int, tuple[str, NDArray[np.int64]]]) -> None:
        """Show where everything is: a ball at the middle of each pin's nodes leads them.

        Args:
            bodies: where they are, by name.
            pins: cloth and nodes of those that hold, by number.
        """
        job, drawing = self._job, self._drawing
        with drawing.picture():
            for name, part, vertices, faces in self._pieces:
                pose, color = bodies[name].arrays, color_of(job, name, part, BODY_COLOR)
                drawing.mesh(
                    f"/body/{name}/{part}", vertices, faces, color,
                    position=pose["position"], orientation=pose["orientation"],
                )  # fmt: skip
            for cloth in job.cloth:
                sheet, color = bodies[cloth.name].arrays, color_of(job, cloth.name, BODY, CLOTH)
                drawing.mesh(f"/cloth/{cloth.name}", sheet["position"], sheet["triangles"], color, two_sided=True)
            for fluid in job.fluid:
                color = color_of(job, fluid.name, BODY, SURFACE)
                position = np.asarray(bodies[fluid.name].arrays["position"], np.float32)
                drawing.points(f"/fluid/{fluid.name}", position, color, radius=fluid.particle_radius)
            for number, (cloth_name, nodes) in pins.items():
                middle = bodies[cloth_name].arrays["position"][nodes].mean(axis=0)
                drawing.mesh(f"/pin/{number}", self._ball.vertices, self._ball.faces, PIN, position=middle)

    def _make_draggable(self, path: str, handle: Any) -> None:
        kind, name = path.split("/")[1:3]
        if kind == "fluid" or (kind == "body" and name not in self._job.moving_bodies):
            return

        async def on_drag(event: Any) -> None:  # a coroutine, as only these keep their order
            self._on_drag(kind, name, event)

        handle.on_drag(on_drag)
