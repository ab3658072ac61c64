"""What a scene looks like on the page: things that are made once, and of which only what moved is sent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.job.looks import parts_of
from pipeline.view.colors import BODY, CLOTH, PIN, SURFACE, srgb

if TYPE_CHECKING:
    import viser

    from pipeline.job.models import Job
    from sim.snapshots import Snapshot

Rgb = tuple[int, int, int]
Drag = Callable[[str, str, Any], None]
"""Called with the kind of the thing, its name and viser's event."""

FLOOR_COLOR: Rgb = (170, 176, 184)

PIN_SHARE = 0.012
"""Radius of a pin's handle, in diagonals of what is there."""


class SceneDrawing:
    """The bodies of a job in the scene of a viser server."""

    def __init__(self, server: viser.ViserServer, job: Job, bodies: Mapping[str, Snapshot], on_drag: Drag) -> None:
        self._server = server
        self._handles: dict[str, Any] = {}
        self._pins: list[tuple[str, NDArray[np.int64], Any]] = []
        self._last: dict[str, Any] = {}
        self._on_drag = on_drag
        scene = server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)  # a machine without a GPU draws thrice as fast
        low, high = np.asarray(job.domain.min), np.asarray(job.domain.max)
        middle, self._size = (low + high) / 2.0, float(np.linalg.norm(high - low))
        if "z-" not in job.domain.open_faces:
            width, depth = (float(each) for each in (high - low)[:2])
            place = (float(middle[0]), float(middle[1]), float(low[2]) - 1e-3)
            scene.add_grid(
                "/floor", width=width, height=depth, plane="xy", cell_size=0.1, section_size=0.5, position=place,
                    cell_color=FLOOR_COLOR, section_color=FLOOR_COLOR,
            )  # fmt: skip
        camera = server.initial_camera
        if job.camera.position is not None and not isinstance(job.camera.look_at, str):
            camera.position = np.asarray(job.camera.position)
            camera.look_at = middle if job.camera.look_at is None else np.asarray(job.camera.look_at)
        else:
            camera.position, camera.look_at = middle + self._size * np.array([0.35, -0.8, 0.35]), middle
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = float(np.radians(45.0))
        for number, body in enumerate(job.rigid):
            self._add_body(job, number, body.name)
        for cloth in job.cloth:
            arrays = bodies[cloth.name].arrays
            color = _color(job, cloth.name, CLOTH)
            handle = scene.add_mesh_simple(
                f"/cloth/{cloth.name}", arrays["position"], arrays["triangles"], color=color, side="double"
            )
            self._keep("cloth", cloth.name, handle)
        for fluid in job.fluid:
            arrays, radius = bodies[fluid.name].arrays, fluid.particle_radius
            self._handles[fluid.name] = scene.add_point_cloud(
                f"/fluid/{fluid.name}", arrays["position"], _color(job, fluid.name, SURFACE),
                point_size=2.0 * radius, point_shape="circle", precision="float32",
            )  # fmt: skip

    def add_pins(self, pins: list[tuple[str, NDArray[np.int64]]]) -> None:
        """A ball at the middle of each pin's nodes, which leads them."""
        for number, (cloth, nodes) in enumerate(pins):
            handle = self._server.scene.add_icosphere(
                f"/pin/{number}", radius=PIN_SHARE * self._size, color=PIN, subdivisions=2
            )
            self._keep("pin", str(number), handle, named=False)
            self._pins.append((cloth, nodes, handle))

    def show(self, bodies: Mapping[str, Snapshot]) -> None:
        """Send what has moved since the last time; pages that are behind get the newest state only."""
        with self._server.atomic():
            for name, snapshot in bodies.items():
                handle = self._handles[name]
                if snapshot.kind == "rigid":
                    pose = (*snapshot.arrays["position"].tolist(), *snapshot.arrays["orientation"].tolist())
                    if self._last.get(name) != pose:
                        self._last[name] = pose
                        handle.position, handle.wxyz = pose[:3], pose[3:]
                elif snapshot.kind == "cloth":
                    handle.vertices = snapshot.arrays["position"]
                elif snapshot.kind == "fluid":
                    self._show_particles(handle, snapshot.arrays["position"])
            for cloth, nodes, handle in self._pins:
                handle.position = bodies[cloth].arrays["position"][nodes].mean(axis=0)

    def _show_particles(self, handle: Any, position: NDArray[Any]) -> None:
        if len(position) != len(handle.points):  # emitters add to them
            handle.colors = np.broadcast_to(np.asarray(handle.colors).reshape(-1, 3)[0], position.shape)
        handle.points = position

    def _add_body(self, job: Job, number: int, name: str) -> None:
        from sim.rigid.static import StaticBody

        parameters = job.rigid[number]
        mesh = StaticBody(parameters).rest_mesh()
        frame = self._server.scene.add_frame(
            f"/body/{name}", show_axes=False, position=parameters.position, wxyz=(1.0, 0.0, 0.0, 0.0)
        )
        self._handles[name] = frame
        for part in parts_of(parameters.shape.type):
            piece = mesh.piece(part)
            color = _color(job, name, BODY, part)
            handle = self._server.scene.add_mesh_simple(
                f"/body/{name}/{part}", piece.vertices.astype(np.float32), piece.faces, color=color
            )
            if name in job.moving_bodies:
                self._make_draggable("body", name, handle)

    def _keep(self, kind: str, name: str, handle: Any, *, named: bool = True) -> None:
        if named:
            self._handles[name] = handle
        self._make_draggable(kind, name, handle)

    def _make_draggable(self, kind: str, name: str, handle: Any) -> None:
        async def on_drag(event: Any) -> None:  # a coroutine, as only these keep their order
            self._on_drag(kind, name, event)

        handle.on_drag(on_drag)


def _color(job: Job, body: str, usual: Rgb, part: str = "body") -> Rgb:
    """The job's colour of a body, for a screen; a usual one where it gives none."""
    color = job.material_of(body, part).color
    return usual if color is None else srgb(color)
