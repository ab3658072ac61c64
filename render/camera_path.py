"""The camera's path: still, along keyframes, around a point, or with a body; and the automatic framing of a box."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.parameters import CameraParameters, Vector3

Array = NDArray[np.float64]

SENSOR_WIDTH_MM = 36.0
AZIMUTH = math.radians(-62.0)
ELEVATION = math.radians(17.0)  # a three-quarter view from slightly above: both sides of a box and its top are seen
HORIZON = 0.8  # how high above the middle of the picture the horizon is at most, in halves of its height
MARGIN = 0.05  # share of the picture that stays free on each side

TURNS_FROM_DEG = 45.0
"""A camera that goes farther around the scene than this sees beside a backdrop that stands behind it."""

NEAREST_FOCUS_M = 1.0e-3
RIM_POINTS = 32
VIEWS_VERSION = 1
FRAMING_VERSION = 2
"""Raised when a camera frames the same points from elsewhere."""


@dataclass(frozen=True)
class View:
    """The view at one time.

    Attributes:
        position, look_at: of the camera, and the point in the middle of the picture [m].
        focal_length_mm: on a sensor 36 mm wide [mm].
        focus_distance: of the plane in focus, along the view [m].
    """

    position: Vector3
    look_at: Vector3
    focal_length_mm: float
    focus_distance: float

    def axes(self) -> Array:
        """The camera's axes, right, up and back, as rows (3, 3)."""
        back = np.subtract(self.position, self.look_at)
        back = back / max(float(np.linalg.norm(back)), 1e-12)
        right = np.cross((0.0, 0.0, 1.0), back)
        if np.linalg.norm(right) < 1e-9:  # straight up or down
            right = np.array([1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])


def frame_points(points: Array, *, focal_length_mm: float, aspect: float) -> tuple[Vector3, Vector3]:
    """The closest view from the heading `AZIMUTH` that shows all points and the horizon.

    In camera axes (right x, up y, forward z) a point is inside the frustum of a camera at (a, b, -d) if
    |x - a| <= t_x (z + d) and |y - b| <= t_y (z + d), where t is the tangent of half the field of view. For one axis
    alone the smallest d is (max(x/t - z) + max(-x/t - z)) / 2, and a lies in the middle; the larger d of the two
    axes serves both.

    The view is inclined by `ELEVATION`, or by less if the horizon is in the picture then. What room is left above and
    below lets the camera rise, until it stands `ELEVATION` above the middle of the points or they lie at the margin.

    Args:
        points: that are shown [m], (n, 3).
        focal_length_mm: of the lens, on a 36 mm sensor.
        aspect: width over height of the picture.

    Returns:
        Where the camera stands and what it looks at [m].
    """
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    # Blender's sensor fits the longer side of the picture.
    tangent_long = SENSOR_WIDTH_MM / 2 / focal_length_mm
    half_width, half_height = tangent_long * min(1.0, aspect), tangent_long / max(1.0, aspect)
    pitch = min(ELEVATION, math.atan(HORIZON * half_height))
    forward = -np.array([math.cos(pitch) * math.cos(AZIMUTH), math.cos(pitch) * math.sin(AZIMUTH), math.sin(pitch)])
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    x, y, z = ((points - centre) @ np.stack([right, up, forward], axis=1)).T

    tangent_x, tangent_y = (half * (1 - 2 * MARGIN) for half in (half_width, half_height))
    distances, shifts = [], []
    for offset, tangent in ((x, tangent_x), (y, tangent_y)):
        positive, negative = np.max(offset / tangent - z), np.max(-offset / tangent - z)
        distances.append((positive + negative) / 2)
        shifts.append(tangent * (positive - negative) / 2)
    distance = max(distances)
    highest = float(np.min(y + tangent_y * (z + distance)))
    rise = max(shifts[1], min(highest, distance * math.tan(ELEVATION - pitch)))
    target = centre + shifts[0] * right + rise * up
    return _vector(target - distance * forward), _vector(target)


def _frame_all_round(points: Array, *, focal_length_mm: float, aspect: float) -> tuple[Vector3, Vector3]:
    """The closest view from which all points stay in the picture as it turns about the vertical axis in their middle.

    Each turns in a circle, and all of these are framed. The point looked at is moved along the view onto the axis.
    """
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    # The corners of the polygon around a circle, so that no part of it is left out.
    radius = np.linalg.norm(points[:, :2] - centre[:2], axis=1) / math.cos(math.pi / RIM_POINTS)
    angles = AZIMUTH + np.linspace(0.0, 2.0 * math.pi, RIM_POINTS, endpoint=False)
    around = centre[:2] + radius[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heights = np.broadcast_to(points[:, None, 2:], (*around.shape[:2], 1))
    circles = np.concatenate([around, heights], axis=2).reshape(-1, 3)
    position, target = map(np.array, frame_points(circles, focal_length_mm=focal_length_mm, aspect=aspect))
    forward = target - position
    along = (centre[:2] - target[:2]) @ forward[:2] / (forward[:2] @ forward[:2])
    return _vector(position), _vector(target + along * forward)


def corners_of_boxes(boxes: ArrayLike) -> Array:
    """Corners of boxes, of lower and upper corners (n, 2, 3): (8 n, 3)."""
    corners = [[*itertools.product(*zip(*box, strict=True))] for box in np.asarray(boxes, dtype=np.float64)]
    return np.concatenate(corners)


class CameraPath:
    """The view of a job's camera at any time.

    Attributes:
        moves: whether views differ.
        bodies: names of the bodies that the views depend on.

    Args:
        camera: as the job describes it; its bodies are all in `starts`.
        box_min, box_max: corners of the domain, which a camera without a position frames if nothing else is named [m].
        aspect: width over height of the picture.
        starts: where bodies are at the start [m].
        framed: points that a camera without a position frames instead [m], (n, 3); from all sides if it goes around.
    """

    def __init__(
        self,
        camera: CameraParameters,
        box_min: Sequence[float],
        box_max: Sequence[float],
        *,
        aspect: float,
        starts: Mapping[str, Sequence[float]],
        framed: Array | None = None,
    ) -> None:
        self._camera, self._aimed_at = camera, camera.look_at if isinstance(camera.look_at, str) else None
        named = (camera.follow, camera.focus if isinstance(camera.focus, str) else None, self._aimed_at)
        self.bodies = tuple(dict.fromkeys(name for name in named if name is not None))
        self._starts = {name: np.asarray(starts[name], dtype=np.float64) for name in self.bodies}
        self.moves = camera.moves
        self._times = [key.time_s for key in camera.keyframe]
        self._centre = (np.asarray(box_min, dtype=np.float64) + np.asarray(box_max, dtype=np.float64)) / 2
        look_at = None if isinstance(camera.look_at, str) else camera.look_at
        if camera.frames:
            frame = _frame_all_round if camera.orbit_deg_per_s else frame_points
            points = corners_of_boxes([(box_min, box_max)]) if framed is None else framed
            position, middle = frame(points, focal_length_mm=camera.focal_length_mm, aspect=aspect)
        else:
            position, middle = camera.position or camera.keyframe[0].position, _vector(self._centre)
        self._position, self._look_at = np.array(position), np.array(middle if look_at is None else look_at)
        self._interpolate = self._through_keyframes() if camera.keyframe else None

    def view(self, time_s: float, bodies: Mapping[str, Sequence[float]]) -> View:
        """The view at a time [s] at which `bodies` are at these places [m]."""
        places = {name: np.asarray(bodies[name], dtype=np.float64) for name in self.bodies}
        camera = self._camera
        position, look_at, focal_length = self._position, self._look_at, camera.focal_length_mm
        if self._interpolate is not None:
            values = self._interpolate(time_s)
            position, look_at, focal_length = values[:3], values[3:6], float(values[6])
        if camera.follow is not None:
            shift = places[camera.follow] - self._starts[camera.follow]
            position, look_at = position + shift, look_at + shift
        if self._aimed_at is not None:
            look_at = places[self._aimed_at]
        if camera.orbit_deg_per_s:
            position = look_at + _turned(position - look_at, math.radians(camera.orbit_deg_per_s) * time_s)
        distance = float(np.linalg.norm(look_at - position))
        if camera.focus is not None:
            forward = (look_at - position) / max(distance, NEAREST_FOCUS_M)
            in_focus = places[camera.focus] if isinstance(camera.focus, str) else np.asarray(camera.focus)
            distance = float((in_focus - position) @ forward)
        return View(_vector(position), _vector(look_at), focal_length, max(distance, NEAREST_FOCUS_M))

    def first(self) -> View:
        """The view at the start."""
        return self.view(0.0, {name: place.tolist() for name, place in self._starts.items()})

    def longest_focal_length(self) -> float:
        """Of all views [mm]."""
        keyframes = [key.focal_length_mm or self._camera.focal_length_mm for key in self._camera.keyframe]
        return max(keyframes, default=self._camera.focal_length_mm)

    def distance_all_round(self) -> float | None:
        """How far from the domain's middle it gets [m], if it sees behind its first place, or None.

        That of an orbit does, however slow: it is not known here how long the film is. Bodies stand where they start.
        """
        if self._interpolate is not None:
            times = np.unique([t for a, b in pairwise(self._times) for t in np.linspace(a, b, 17)] or self._times)
            values = np.array([self._interpolate(time) for time in times])
            towards = (values[:, :3] - values[:, 3:6])[:, :2]
            headings = np.unwrap(np.arctan2(towards[:, 1], towards[:, 0]))
            if np.ptp(headings) <= math.radians(TURNS_FROM_DEG):
                return None
            return float(np.linalg.norm((values[:, :3] - self._centre)[:, :2], axis=1).max())
        if not self._camera.orbit_deg_per_s:
            return None
        view = self.first()
        position, middle = np.array(view.position), np.array(view.look_at)
        return float(np.linalg.norm((position - middle)[:2]) + np.linalg.norm((middle - self._centre)[:2]))

    def _through_keyframes(self) -> _Interpolation:
        camera = self._camera
        rows = []
        for key in camera.keyframe:
            look_at = self._look_at if key.look_at is None else key.look_at
            rows.append((*key.position, *look_at, key.focal_length_mm or camera.focal_length_mm))
        return _Interpolation(self._times, np.array(rows, dtype=np.float64), eases=camera.easing == "smooth")


class _Interpolation:
    """Through rows of values at times; constant before the first and after the last.

    Smooth: cubic without overshoot (Fritsch & Butland 1984), at rest at both ends. Else straight.
    """

    def __init__(self, times: Sequence[float], rows: Array, *, eases: bool) -> None:
        from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

        self._times, self._rows, self._curve = np.asarray(times, dtype=np.float64), rows, None
        if eases and len(times) > 1:
            slopes = PchipInterpolator(self._times, rows).derivative()(self._times)
            slopes[[0, -1]] = 0.0
            self._curve = CubicHermiteSpline(self._times, rows, slopes)

    def __call__(self, time_s: float) -> Array:
        time = float(np.clip(time_s, self._times[0], self._times[-1]))
        if self._curve is not None:
            return np.asarray(self._curve(time), dtype=np.float64)
        return np.array([np.interp(time, self._times, column) for column in self._rows.T])


def write_views(path: Path, frame: int, views: Mapping[float, View]) -> None:
    """Write the views while a frame's shutter is open, by time from the frame's [frames]; docs/guide/formats.md."""
    document = {
        "version": VIEWS_VERSION,
        "frame": frame,
        "views": [{"offset": offset, **asdict(view)} for offset, view in views.items()],
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _turned(vector: Array, angle: float) -> Array:
    """About the vertical axis, counter-clockwise seen from above."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1], vector[2]])


def _vector(values: Array | Sequence[float]) -> Vector3:
    x, y, z = map(float, values)
    return x, y, z
