"""Checks of the camera against the scene as it starts: what it stands in, and what it does not see.

Bodies are known here where they start, so a camera that goes with one is checked at the start alone; what the film
itself shows is looked at when a frame is drawn.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import MissingInputError
from pipeline.kinds.table import bodies, scene_points
from pipeline.model.boxes import Box, domain_box, smoke_box, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.camera_path import CameraPath, View
from render.parameters import Vector3
from render.visibility import clip_range, in_picture, points_of_box
from sim.shapes.solid import Solid

SAMPLES = 121
"""Times at which the way of a camera is looked at."""
CAMERA: KeyPath = ("camera",)


def check_camera(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """Note where the camera is inside of something, below the ground, or sees nothing."""
    _check_places(job, solids, findings)
    if any(problem.path[:1] == CAMERA for problem in findings.errors):
        return  # what else it does follows from that
    if job.camera.frames_action:
        return  # its place follows from the film, which it then shows
    width, height = job.render.resolution
    starts = {body.name: body.position for body in job.rigid}
    try:
        framed = scene_points(job)
    except MissingInputError:
        return  # the file is refused where the body is looked at
    path = CameraPath(
        job.placed_camera, job.domain.min, job.domain.max, aspect=width / height, starts=starts, framed=framed
    )
    last_s = (job.frame_count - 1) / job.fps
    views = {0.0: path.first()}
    if path.moves and not path.bodies:
        views |= {float(time_s): path.view(float(time_s), {}) for time_s in np.linspace(0.0, last_s, SAMPLES)}
    _check_way(job, solids, views, findings)
    _check_ground(job, views, findings)
    _check_sight(job, solids, views, findings)
    _check_clipping(job, solids, path.first(), findings)


def _check_places(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """The places that the job names: bodies that move, and water, may be elsewhere when the camera comes there."""
    places: dict[KeyPath, Vector3] = {
        ("camera", "keyframe", number, "position"): key.position for number, key in enumerate(job.camera.keyframe)
    }
    if job.camera.position is not None:
        places["camera", "position"] = job.camera.position
    for place, position in places.items():
        for path, solid in solids.items():
            if path[0] == "smoke" or not _contains(solid, position):
                continue
            if place[1] == "position" or job.camera.keyframe[int(place[2])].time_s == 0.0 or _stands(job, path):
                findings.error(place, f'is inside "{_name(job, path)}"; move it out')
            else:
                findings.warn(place, f'is where "{_name(job, path)}" is at the start')


def _stands(job: Job, path: KeyPath) -> bool:
    return path[0] == "rigid" and next(body for body in job.rigid if body.name == _name(job, path)).kind == "static"


def _check_way(job: Job, solids: Mapping[KeyPath, Solid], views: Mapping[float, View], findings: Findings) -> None:
    """Between the places: bodies that stand still are there all the time."""
    static = {path: solid for path, solid in solids.items() if _stands(job, path)}
    for path, solid in static.items():
        inside = [time_s for time_s, view in views.items() if _contains(solid, view.position)]
        if inside:
            findings.warn(CAMERA, f'passes through "{_name(job, path)}" at {inside[0]:.3g} s; lead it around')


def _check_ground(job: Job, views: Mapping[float, View], findings: Findings) -> None:
    ground = job.domain.min[2]
    below = [time_s for time_s, view in views.items() if view.position[2] < ground]
    if below:
        findings.warn(
            CAMERA, f"is below the ground, z = {ground:g} m, at {below[0]:.3g} s, and sees its lower side; raise it"
        )


def _check_sight(job: Job, solids: Mapping[KeyPath, Solid], views: Mapping[float, View], findings: Findings) -> None:
    """At the start something of the scene is to be seen, later at least a part of where anything can be."""
    width, height = job.render.resolution
    aspect = width / height
    everywhere = np.concatenate(
        [
            points_of_box(*box)
            for box in (domain_box(job.domain), *(smoke_box(smoke, job.domain) for smoke in job.smoke))
        ]
    )
    at_start = [points_of_box(*solid.bounds) for solid in solids.values()]
    at_start += [np.array([body.position]) for _, _, body in bodies(job) if hasattr(body, "position")]
    times = sorted(views)
    if not _sees(views[times[0]], np.concatenate(at_start) if at_start else everywhere, aspect):
        findings.warn(CAMERA, "looks away from everything at the start: no body is in the picture")
    later = [times[len(times) // 2], times[-1]] if len(times) > 1 else []
    lost = [f"at {time_s:.3g} s" for time_s in later if not _sees(views[time_s], everywhere, aspect)]
    if lost:
        findings.warn(CAMERA, f"looks away from the domain {' and '.join(lost)}: nothing of it is in the picture")


def _check_clipping(job: Job, solids: Mapping[KeyPath, Solid], view: View, findings: Findings) -> None:
    nearest, farthest = clip_range(view)
    eye = np.array(view.position)
    for path, solid in solids.items():
        distance = _distance(eye, solid.bounds)
        if 0.0 < distance < nearest:
            findings.warn(
                CAMERA,
                f'is {distance:.2g} m from "{_name(job, path)}", and draws nothing nearer than {nearest:.2g} m, a '
                "thousandth of the way to what it looks at; let it look at something nearer",
            )
    if _distance(eye, domain_box(job.domain)) > farthest:
        findings.warn(
            CAMERA,
            f"draws nothing farther than {farthest:.2g} m, a thousand times the way to what it looks at, and the "
            "domain is; let it look at something farther",
        )


def _contains(solid: Solid, position: Vector3) -> bool:
    eye = np.array([position])
    return touch(solid.bounds, np.repeat(eye, 2, axis=0), margin=0.0) and bool(solid.signed_distance(eye)[0] < 0.0)


def _sees(view: View, points: NDArray[np.float64], aspect: float) -> bool:
    return bool(in_picture(view, points, aspect=aspect).any())


def _distance(point: NDArray[np.float64], box: Box) -> float:
    """From a point to a box [m]; 0 inside."""
    return float(np.linalg.norm(np.maximum(np.maximum(box[0] - point, point - box[1]), 0.0)))


def _name(job: Job, path: KeyPath) -> str:
    return str(getattr(job, str(path[0]))[path[1]].name)
