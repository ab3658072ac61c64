"""A canvas in a browser: things by name, of which only what has changed is sent.

It knows arrays, not jobs. viser keeps, for each thing, only its last state for pages that lag behind, so a slow page
skips states and holds up nobody.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations, product
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from pipeline.web.drawing.colors import Colors
from pipeline.web.drawing.smoke_pictures import Slice
from render.camera_path import SENSOR_WIDTH_MM, View

Rgb = tuple[int, int, int]
NO_TURN = (1.0, 0.0, 0.0, 0.0)
HALF_PRECISION = 2.0**-11
"""Error of a 16-bit float, relative to its size."""
MOST_ERROR_IN_RADII = 0.1
"""Of particles' places; where 16 bits would be wronger, they are sent with 32."""


class Canvas:
    """The scene of a viser server. Not for several threads at once.

    `when_new` is called with the name and viser's handle of each thing that is made, also of one that is made anew.
    """

    def __init__(
        self, server: viser.ViserServer, *, when_new: Callable[[str, Any], None] = lambda _name, _handle: None
    ) -> None:
        self._server, self._when_new = server, when_new
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(cast_shadow=False)  # a machine without a GPU draws thrice as fast
        self._handles: dict[str, Any] = {}
        self._drawn: set[str] = set()
        self._kinds: dict[str, tuple[object, ...]] = {}

    @property
    def names(self) -> frozenset[str]:
        """Names of all things."""
        return frozenset(self._handles)

    @contextmanager
    def picture(self) -> Iterator[None]:
        """A whole picture: what is not drawn in the block is removed; pages get it in one piece."""
        self._drawn = set()
        with self._server.atomic():
            yield
            for name in [name for name in self._handles if name not in self._drawn]:
                self._handles.pop(name).remove()
                del self._kinds[name]

    def points(self, name: str, position: NDArray[np.float32], colors: Colors | Rgb, *, radius: float) -> None:
        """Round particles at positions [m], (n, 3), of one radius [m]; colours of each, (n, 3), or of all."""
        if not len(position):
            return
        middle = (position.min(axis=0) + position.max(axis=0)) / 2.0
        local = position - middle
        exact = float(np.abs(local).max()) * HALF_PRECISION > MOST_ERROR_IN_RADII * radius
        colors = np.broadcast_to(np.asarray(colors, np.uint8), position.shape)
        handle = self._kept(name, "points", len(position), exact)
        if handle is None:
            handle = self._server.scene.add_point_cloud(
                name,
                local,
                colors,
                point_size=2.0 * radius,
                point_shape="circle",
                precision="float32" if exact else "float16",
                position=middle,
            )
            self._keep(name, handle, "points", len(position), exact)
            return
        handle.points, handle.colors, handle.position = local, colors, middle
        handle.point_size = 2.0 * radius

    def mesh(
        self,
        name: str,
        vertices: ArrayLike,
        faces: ArrayLike,
        color: Rgb,
        *,
        opacity: float | None = None,
        two_sided: bool = False,
        position: ArrayLike = (0.0, 0.0, 0.0),
        orientation: ArrayLike = NO_TURN,
    ) -> None:
        """A triangle mesh of vertices [m], (n, 3), in its own axes, and faces, (k, 3), in sRGB, opaque or not.

        Its axes are at a position [m] and turned by a unit quaternion w, x, y, z; cloth is two-sided.
        """
        rows, triangles = np.asarray(vertices, np.float32), np.asarray(faces, np.uint32)
        if not len(triangles):
            return
        key = (len(rows), len(triangles), opacity, two_sided)
        handle = self._kept(name, "mesh", *key)
        place, turn = _vector(position), _quaternion(orientation)
        if handle is None:
            handle = self._server.scene.add_mesh_simple(
                name,
                rows,
                triangles,
                color=color,
                opacity=opacity,
                side="double" if two_sided or opacity is not None else "front",
                position=place,
                wxyz=turn,
            )
            self._keep(name, handle, "mesh", *key)
            return
        handle.vertices, handle.faces, handle.color = rows, triangles, color
        handle.position, handle.wxyz = place, turn

    def lines(self, name: str, segments: ArrayLike, color: Rgb, *, pixels: float = 1.5) -> None:
        """Straight lines: (n, 2, 3) [m], all so many pixels thick, however far away."""
        points = np.asarray(segments, np.float32)
        handle = self._kept(name, "lines", points.tobytes(), color, pixels)
        if handle is None:
            handle = self._server.scene.add_line_segments(
                name, points, color, thickness=pixels, thickness_units="screen"
            )
            self._keep(name, handle, "lines", points.tobytes(), color, pixels)

    def slice(self, name: str, cut: Slice) -> None:
        """A picture that stands in the scene."""
        width, height = float(np.linalg.norm(cut.right)), float(np.linalg.norm(cut.up))
        right, up = cut.right / width, cut.up / height
        # The picture's own axes: x to the right, y down, z away from who sees it upright.
        turn = quaternion_of(np.stack([right, -up, np.cross(right, -up)], axis=1))
        middle = cut.corner + (cut.right + cut.up) / 2.0
        handle = self._server.scene.add_image(
            name, cut.picture, width, height, format="png", wxyz=turn, position=middle, cast_shadow=False
        )
        self._keep(name, handle, "slice")

    def camera(self, name: str, view: View, *, aspect: float, size: float, color: Rgb) -> None:
        """The film's camera: `size` [m] is how far its frustum reaches."""
        fov, turn, position = vertical_fov(view, aspect), camera_orientation(view), _vector(view.position)
        handle = self._kept(name, "camera", aspect, size)
        if handle is None:
            handle = self._server.scene.add_camera_frustum(
                name, fov, aspect, scale=size, thickness=size / 60.0, color=color, wxyz=turn, position=position
            )
            self._keep(name, handle, "camera", aspect, size)
            return
        handle.fov, handle.wxyz, handle.position = fov, turn, position

    def _kept(self, name: str, *kind: object) -> Any:
        """The thing of this name if it can become the new one by changing its numbers."""
        self._drawn.add(name)
        return self._handles.get(name) if self._kinds.get(name) == kind else None

    def _keep(self, name: str, handle: Any, *kind: object) -> None:
        self._drawn.add(name)
        self._handles[name], self._kinds[name] = handle, kind
        self._when_new(name, handle)


def box_edges(low: Sequence[float], high: Sequence[float]) -> NDArray[np.float32]:
    """The twelve edges of a box [m], (12, 2, 3)."""
    corners = np.array(list(product(*zip(low, high, strict=True))), np.float32)
    pairs = [pair for pair in combinations(range(8), 2) if np.count_nonzero(np.diff(corners[list(pair)], axis=0)) == 1]
    return corners[pairs]


def _vector(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, np.float64)


def _quaternion(values: ArrayLike) -> NDArray[np.float64]:
    quaternion = _vector(values)
    return quaternion / np.linalg.norm(quaternion)


# --- cameras ---


def begin_at(server: viser.ViserServer, position: ArrayLike, target: ArrayLike, *, fov: float) -> None:
    """Have pages begin at a place, looking at another [m], with this angle from the lower to the upper edge [rad]."""
    camera = server.initial_camera
    camera.position, camera.look_at = np.asarray(position, np.float64), np.asarray(target, np.float64)
    camera.up, camera.fov = (0.0, 0.0, 1.0), fov


def vertical_fov(view: View, aspect: float) -> float:
    """Angle between the lower and the upper edge of a picture [rad]; Blender's sensor fits its longer side."""
    tangent = SENSOR_WIDTH_MM / 2.0 / view.focal_length_mm
    return 2.0 * float(np.arctan(tangent / max(1.0, aspect)))


def camera_orientation(view: View) -> NDArray[np.float64]:
    """Unit quaternion w, x, y, z of a camera whose axes are right, down and forward, level as Blender's is."""
    forward = np.asarray(view.look_at, np.float64) - np.asarray(view.position, np.float64)
    distance = np.linalg.norm(forward)
    forward = forward / distance if distance > 0.0 else np.array([0.0, 0.0, -1.0])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return quaternion_of(np.stack([right, np.cross(forward, right), forward], axis=1))


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion w, x, y, z of a rotation matrix, whose columns are the turned axes."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])
