"""A running scene on the canvas, and which of its things can be dragged."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from pipeline.kinds.rigid import is_animated
from pipeline.kinds.table import KINDS
from pipeline.model.job import Job
from pipeline.web.drawing.bodies import Look, Mesh, Setting, body_of, draw_bodies, meshes_at_rest
from pipeline.web.drawing.canvas import Canvas, Rgb, begin_at
from pipeline.web.drawing.colors import PIN
from pipeline.web.live.drags import is_draggable
from render.parameters import CameraParameters
from sim.core.snapshots import Snapshot

OnDrag = Callable[[str, str, Any], None]
"""Called with the kind of the thing, its name and viser's event."""

FLOOR_COLOR: Rgb = (170, 176, 184)
PIN_SHARE = 0.012
"""Radius of a pin's handle, in diagonals of the domain."""
ALL = 2**31
"""Particles: as few as run live are drawn all."""


class LiveScene:
    """The bodies of a running job in the scene of a viser server.

    Args:
        job: as it is simulated.
        of_film: the placed camera of the job as it was read: bodies that rest there stand still no more in `job`.
        on_drag: called when bodies that move, cloths and pins are dragged.
    """

    def __init__(self, server: viser.ViserServer, job: Job, of_film: CameraParameters, on_drag: OnDrag) -> None:
        from trimesh.creation import icosphere

        self._job, self._on_drag = job, on_drag
        self._canvas = Canvas(server, when_new=self._make_draggable)
        low, high = np.asarray(job.domain.min), np.asarray(job.domain.max)
        middle, size = (low + high) / 2.0, float(np.linalg.norm(high - low))
        if "z-" not in job.domain.open_faces:
            width, depth = (float(each) for each in (high - low)[:2])
            place = (float(middle[0]), float(middle[1]), float(low[2]) - 1e-3)
            floor = server.scene.add_grid("/floor", width, depth, cell_size=0.1, section_size=0.5, position=place)
            floor.cell_color = floor.section_color = FLOOR_COLOR
        position, target = middle + size * np.array([0.35, -0.8, 0.35]), middle
        if of_film.position is not None and not isinstance(of_film.look_at, str):
            position = np.asarray(of_film.position)
            target = middle if of_film.look_at is None else np.asarray(of_film.look_at)
        begin_at(server, position, target, fov=float(np.radians(45.0)))
        self._ball = icosphere(subdivisions=2, radius=PIN_SHARE * size)
        meshes: dict[tuple[str, str], Mesh] = {}
        for body in job.rigid:
            meshes |= meshes_at_rest(body) if body.is_own_model and not is_animated(body) else {}
        look = Look(frozenset(kind.display.layer for kind in KINDS.values()))
        self._setting = Setting(job, lambda body, part: meshes[body, part], look)

    def show(self, snapshots: Mapping[str, Snapshot], pins: Mapping[int, tuple[str, NDArray[np.int64]]]) -> None:
        """Show where all bodies are, by name, and a ball at the middle of each pin's nodes, by the pin's number."""
        bodies = {name: body_of(snapshot, ALL) for name, snapshot in snapshots.items()}
        with self._canvas.picture():
            draw_bodies(self._canvas, bodies, self._setting)
            for number, (cloth, nodes) in pins.items():
                middle = snapshots[cloth].arrays["position"][nodes].mean(axis=0)
                self._canvas.mesh(f"/pin/{number}", self._ball.vertices, self._ball.faces, PIN, position=middle)

    def _make_draggable(self, path: str, handle: Any) -> None:
        kind, name = path.split("/")[1:3]
        if not is_draggable(self._job, kind, name):
            return

        async def on_drag(event: Any) -> None:  # a coroutine, as only these keep their order
            self._on_drag(kind, name, event)

        handle.on_drag(on_drag)
