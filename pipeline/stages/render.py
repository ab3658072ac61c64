"""Render: each frame of the job, drawn by Blender's Cycles."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from math import cos, prod, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cache import read_frame
from pipeline.errors import InvalidArtifactError, StageUnavailableError
from pipeline.gpu_kernels import compiled_once
from pipeline.gpus import OWN_GPUS, known_gpus, own_gpus, render_gpus, usable_gpus
from pipeline.job.input_files import split_blend
from pipeline.job.looks import BODY, parts_of
from pipeline.job.models import Job
from pipeline.job.problems import suggestion
from pipeline.layout import JobLayout
from pipeline.own_pictures import own_picture_bytes
from pipeline.parameter_set import ParameterSet, digest_of
from pipeline.stages.base import TaskContext
from pipeline.stages.bounds import read_framed
from pipeline.stages.inputs import content_name, tool_version
from pipeline.stages.sight import BodyAtFrame, bodies_at, expected_cells, warn_of_sight
from pipeline.task import ArtifactPath, Resources, Task, TaskId
from render.camera_path import CameraPath, View, write_views
from render.point_clouds import KINDS
from render.poses import write_poses
from render.spec import (
    Camera,
    MeshObject,
    MeshSequenceObject,
    MovingMeshObject,
    PointSequenceObject,
    RenderSpec,
    SceneObject,
    VolumeSequenceObject,
)
from sim.rigid.parameters import RigidBodyParameters

if TYPE_CHECKING:
    from render.blender import Renderer

Poses = Mapping[str, Mapping[str, NDArray[Any]]]

STAGE_PIXELS = 96
"""Along the longer side of the empty stage that pictures are held against: half a percent of it is 25 pixels."""

BAD_PICTURE = "bad picture"
NO_GPU = "no GPU"
CPU = "CPU"
"""What a renderer calls its device when it draws on none of the GPUs."""

CORES = 2
"""Threads a frame. Cycles with one keeps a second busy waiting: 7.0 s of processor time a frame against 3.7 s with two
(quickstart, draft), so two frames beside each other on two cores take longer than one after the other. The pixels do
not depend on it."""

WORKER_BYTES = 500_000_000
BYTES_PER_PIXEL = 700
"""Measured peaks of the quickstart with denoising, Blender included: 538 MB at 480 x 270 and 1880 MB at 1920 x 1080."""

COMBINED = "ViewLayer.Combined"
"""Blender's name for the picture's layer among passes."""

BYTES_PER_PIXEL_AND_PASS = 200
"""The largest, cryptomatte, has 24 floats a pixel, in Cycles and in what is saved."""

_WITHOUT_EFFECT_ON_PIXELS: dict[str, Any] = {"version": True, "engine": True, "render": {"blender", "order"}}
"""The film is always of Cycles. The executable counts by its version. The device does count: CPU and GPU round
differently."""

_LATER_KEYS: dict[str, Any] = {"format": "png", "passes": []}
_LATER_STAGE_KEYS: dict[str, Any] = {"ground": None, "background": "stage", "hdri": None, "rotation_deg": 0.0}
_LATER_MATERIAL_KEYS: dict[str, Any] = {"blend": None, "caustics": False}
"""Keys that earlier versions did not have, with their values where nothing is said: old frames stay up to date."""

_FORMER_COLOR = [0.22, 0.25, 0.29]
"""What stood for a stage's colour where the job gives none, in those versions."""


class RenderStage:
    """One PNG a frame, and an EXR if the job asks for one. A worker keeps Blender and the scene warm between frames."""

    name = "render"
    version = 3

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame."""
        drawn = render_spec(job, layout)
        spec = _decisive(drawn)
        if job.camera.frames_action:
            # Where it is follows from these and from the box that it frames, which is an input.
            spec["camera"] = {"framing": job.camera.model_dump(mode="json")}
        elif job.camera.moves:
            spec["camera"]["path"] = job.camera.model_dump(mode="json", exclude={"framing"})
        parameters = ParameterSet.of(
            spec,
            stage=self.name,
            version=self.version,
            tools={"blender": _blender_version(job.render.blender)},
        )
        bytes_per_pixel = BYTES_PER_PIXEL + BYTES_PER_PIXEL_AND_PASS * len(job.render.passes)
        renderer_bytes = WORKER_BYTES + own_picture_bytes(drawn)
        resources = Resources(
            cores=CORES,
            memory_bytes=renderer_bytes + bytes_per_pixel * prod(job.render.resolution),
            gpus=int(_draws_on_gpus(job)),
        )
        static = [layout.body_mesh(body.name, part) for body in job.rigid for part in parts_of(body.shape.type)]
        if job.camera.frames_action:
            static.append(layout.film_bounds())
        return [
            Task(
                id=TaskId(f"render/{frame:06d}"),
                stage=self.name,
                inputs=(*static, *_frame_inputs(job, layout, frame)),
                outputs=(layout.picture(frame), *((layout.master(frame),) if job.render.has_master else ())),
                parameters=parameters,
                frame=frame,
                resources=resources,
            )
            for frame in range(job.frame_count)
        ]

    def obstacles(self, job: Job) -> list[str]:
        """No Blender, one that is too old or lacks a shared library, or one without the material or GPU asked for."""
        from render.blender import BlenderUnavailableError, require_bpy, require_supported_executable

        try:
            if job.render.blender is None:
                require_bpy()
            else:
                require_supported_executable(job.render.blender)
            return [*_missing_materials(job), *_missing_gpus(job)]
        except BlenderUnavailableError as error:
            return [str(error)]

    def run(self, context: TaskContext) -> None:
        """Draw one frame.

        Raises:
            InvalidArtifactError: its picture failed the checks twice.
        """
        from render.blender import BlenderDiedError
        from render.pictures import validate_exr, validate_picture

        task, job, layout = context.task, context.job, context.layout
        assert task.frame is not None
        poses, view = write_motion(job, layout, task.frame, attempt=context.attempt)
        bodies = list(bodies_at(job, layout, task.frame, poses))
        warn_of_sight(context, view, bodies)

        def validate(path: Path) -> None:
            validate_picture(path, job.render.resolution, may_be_empty=_may_be_empty(job))

        def validate_master(path: Path) -> None:
            layer = COMBINED if job.render.passes else ""
            validate_exr(path, job.render.resolution, layer=layer, may_be_empty=_may_be_empty(job))

        try:
            with ExitStack() as stack:
                device = _warm_renderer(context).device
                print(f"Cycles draws on {device}{'' if device == CPU else f', GPU {context.gpu}'}", flush=True)
                masters = [
                    stack.enter_context(context.committing(output, validate_master, device=device))
                    for output in task.outputs[1:]
                ]
                path = stack.enter_context(context.committing(task.outputs[0], validate, device=device))
                _draw_until_good(context, [path, *masters], view, bodies)
        except BlenderDiedError:
            _close_renderers()  # the next attempt, maybe in this process, needs a living one
            raise
        layout.rejected_picture(task.frame).unlink(missing_ok=True)
        context.progress(1, 1)


def _draws_on_gpus(job: Job) -> bool:
    """Whether each frame has a GPU for itself. One that the job names is wanted wherever the frames are drawn."""
    return bool(usable_gpus(job)) if job.render.device == "auto" else job.render.device != "cpu"


def _missing_gpus(job: Job) -> Iterator[str]:
    """A kind of GPU that the job names and Cycles does not find here, or a place that the environment names."""
    device, found, own = job.render.device, render_gpus(job), own_gpus() or ()
    absent = [place for place in own if place >= len(found)]
    if found and absent:
        places = "only GPU 0" if len(found) == 1 else f"only the GPUs 0 to {len(found) - 1}"
        yield f"{OWN_GPUS} names GPU {', '.join(map(str, absent))}, but Cycles finds {places} here"
        return
    if device in ("auto", "cpu") or usable_gpus(job):
        return
    if found:
        yield f'render.device is "{device}", but {OWN_GPUS} leaves this process no GPU; use "auto" or "cpu"'
        return
    probe = known_gpus(job.render.blender)
    there = ", ".join(f"{gpu.name} ({gpu.backend.lower()})" for gpu in probe.gpus)
    finds = f"finds only {there}" if there else "finds no GPU"
    trouble = f" ({probe.trouble})" if probe.trouble else ""
    yield f'render.device is "{device}", but Cycles {finds} here{trouble}; use "auto" or "cpu"'


def _missing_materials(job: Job) -> Iterator[str]:
    """Materials of .blend files that are not there: told before hours of simulation, not after.

    Raises:
        BlenderUnavailableError: Blender does not answer.
    """
    from render.blend_file import read_material_names
    from render.errors import InvalidFileError

    wanted: dict[str, dict[str, str]] = {}
    for body, material in job.material.items():
        if material.blend is not None:
            file, name = split_blend(material.blend)
            wanted.setdefault(file, {})[body] = name
    for file, names in wanted.items():
        try:
            there = read_material_names(Path(file), job.render.blender, tried=sorted(set(names.values())))
        except InvalidFileError as error:
            yield str(error)
            continue
        known = f"there are {', '.join(sorted(there))}" if there else "it has none"
        for body, name in names.items():
            if name not in there:
                hint = suggestion(name, there)
                yield f'material.{body}.blend: {file} has no material "{name}"{hint}; {known}'


def _decisive(spec: RenderSpec) -> dict[str, Any]:
    """What of a specification decides pixels: files by their content, and keys of later versions only where used.

    Raises:
        MissingInputError: a file cannot be read.
    """
    document = spec.model_dump(mode="json", exclude=_WITHOUT_EFFECT_ON_PIXELS)
    document["render"]["passes"].sort()  # their order changes nothing
    for key, usual in _LATER_KEYS.items():
        if document["render"][key] == usual:
            del document["render"][key]
    stage = document["stage"]
    for key, unused in _LATER_STAGE_KEYS.items():
        if stage[key] == unused:
            del stage[key]
    if spec.stage.hdri is not None:
        stage["hdri"] = content_name(spec.stage.hdri, "picture")
        stage["name"] = None  # its light and sky are not there
    else:
        stage.pop("rotation_deg", None)  # there is nothing to turn
    if stage["color"] is None and "ground" not in stage and stage["name"] != "window":
        stage["color"] = _FORMER_COLOR
    for drawn in document["objects"]:
        material = drawn["material"]
        for key, unused in _LATER_MATERIAL_KEYS.items():
            if material[key] == unused:
                del material[key]
        if "blend" in material:
            file, name = split_blend(material["blend"])
            drawn["material"] = {"blend": f"{content_name(file, '.blend file')}:{name}"}  # it says all
    return document


def render_spec(job: Job, layout: JobLayout, framed: NDArray[np.float64] | None = None) -> RenderSpec:
    """The job as Blender sees it; paths are relative to the job's folder. `framed` as in `camera_path`."""
    objects: list[SceneObject] = [
        _body_object(job, layout, body, part) for body in job.rigid for part in parts_of(body.shape.type)
    ]
    objects += [
        MeshSequenceObject(
            name=fluid.name, file=f"surfaces/{fluid.name}/{{frame}}.ply", material=job.material_of(fluid.name)
        )
        for fluid in job.fluid
    ]
    objects += [
        MeshSequenceObject(
            name=cloth.name, file=f"cloths/{cloth.name}/{{frame}}.ply", material=job.material_of(cloth.name)
        )
        for cloth in job.cloth
    ]
    objects += [
        PointSequenceObject(
            name=f"{fluid}.{kind}",
            file=f"whitewater/{fluid}/{{frame}}.ply",
            kind=kind,
            material=job.material_of(fluid, kind),
        )
        for fluid in job.whitewater
        for kind in KINDS
    ]
    objects += [
        VolumeSequenceObject(
            name=smoke.name,
            file=f"volumes/{smoke.name}/{{frame}}.vdb",
            box_min=corners[0],
            box_max=corners[1],
            open_faces=smoke.open_faces,
            ambient_temperature=smoke.ambient_temperature,
            material=job.material_of(smoke.name),
        )
        for smoke in job.smoke
        for corners in (smoke.corners(job.domain),)
    ]
    return RenderSpec(
        fps=job.fps,
        domain_min=job.domain.min,
        domain_max=job.domain.max,
        camera=Camera.on(camera_path(job, framed), f_stop=job.camera.f_stop, views=layout.views),
        stage=job.stage,
        lights=job.light,
        objects=tuple(objects),
        render=job.render,
    )


def _body_object(job: Job, layout: JobLayout, body: RigidBodyParameters, part: str) -> SceneObject:
    """A static body stands where the job puts it; the others are where the poses of the frame say."""
    name = body.name if part == BODY else f"{body.name}.{part}"
    file, material = layout.body_mesh(body.name, part), job.material_of(body.name, part)
    if body.kind == "static":
        orientation = _orientation(body.rotation_deg)
        return MeshObject(name=name, file=file, position=body.position, orientation=orientation, material=material)
    return MovingMeshObject(name=name, file=file, body=body.name, poses=layout.poses, material=material)


def camera_path(job: Job, framed: NDArray[np.float64] | None = None) -> CameraPath:
    """Where the camera of a job goes.

    Args:
        job: the job.
        framed: points that it frames if it frames the action [m], (n, 3); the domain while they are not known.
    """
    width, height = job.render.resolution
    starts = {body.name: body.position for body in job.rigid}
    return CameraPath(job.camera, job.domain.min, job.domain.max, aspect=width / height, starts=starts, framed=framed)


@cache
def _blender_version(executable: str | None) -> str:
    """Version of the Blender that draws; wherever it lies, the same version gives the same frames.

    Raises:
        StageUnavailableError: the executable is not there, or not a Blender that can be used.
    """
    from render.blender import BlenderUnavailableError, require_supported_executable

    if executable is None:
        return tool_version("bpy")
    try:
        return ".".join(map(str, require_supported_executable(executable)))
    except BlenderUnavailableError as error:
        raise StageUnavailableError(f"render: {error}") from error


def _frame_inputs(job: Job, layout: JobLayout, frame: int) -> list[ArtifactPath]:
    surfaces = [layout.surface(fluid.name, frame) for fluid in job.fluid]
    volumes = [layout.volume(smoke.name, frame) for smoke in job.smoke]
    points = [layout.whitewater(fluid, frame) for fluid in job.whitewater]
    cloths = [layout.cloth(cloth.name, frame) for cloth in job.cloth]
    # The cache changes with every change of the simulation, so it is an input only where something of it is drawn.
    cached = [layout.frame_cache(frame)] if job.moving_bodies or not surfaces + cloths + volumes else []
    return surfaces + cloths + volumes + points + cached


def framed_points(job: Job, layout: JobLayout) -> NDArray[np.float64] | None:
    """What the camera frames [m], (n, 3), where it frames the action, which a file of the job's folder says."""
    return read_framed(layout.path(layout.film_bounds())) if job.camera.frames_action else None


def write_motion(job: Job, layout: JobLayout, frame: int, *, attempt: int) -> tuple[Poses, View]:
    """Put where bodies and camera are at a frame where Blender finds it; returns it, too.

    These documents are no artifacts, but a form of the cached frame and of the job.

    Args:
        job: the job.
        layout: the folder that holds the cached frame, and gets the documents.
        frame: which frame.
        attempt: names the files that they are written to first.
    """
    bodies, camera = job.moving_bodies, camera_path(job, framed_points(job, layout))
    cached = read_frame(layout.path(layout.frame_cache(frame)), kind="rigid").bodies if bodies else {}
    poses = {name: cached[name].arrays for name in bodies}
    if bodies:
        with _replacing(layout, layout.poses, frame, attempt) as path:
            write_poses(path, frame, poses)
    if camera.moves:
        reach = job.render.reach_of_motion
        views = {}
        for offset in sorted({-reach, 0.0, reach}):
            places = {name: _position_after(offset / job.fps, poses[name]) for name in camera.bodies}
            views[offset] = camera.view((frame + offset) / job.fps, places)
        with _replacing(layout, layout.views, frame, attempt) as path:
            write_views(path, frame, views)
    places = {name: _position_after(0.0, poses[name]) for name in camera.bodies}
    return poses, camera.view(frame / job.fps, places)


def _draw_until_good(context: TaskContext, paths: list[Path], view: View, bodies: Sequence[BodyAtFrame]) -> None:
    """Draw a frame, and once more if its picture fails the checks; a picture that fails again is kept.

    Args:
        context: of the frame's task.
        paths: of the picture, and of the EXR if the job asks for one.
        view: of the camera at the frame.
        bodies: what is to be seen.

    Raises:
        InvalidArtifactError: it failed again.
    """
    from render.errors import InvalidFileError

    frame = context.task.frame
    assert frame is not None
    for once_more in (True, False):
        try:
            _draw(context, frame, paths)
            _check_picture(context, frame, paths[0], view, bodies)
        except InvalidFileError as error:
            if once_more:
                _close_renderers()  # what went wrong in it may stay so
                context.warn(BAD_PICTURE, f"frame {frame}: the picture {error.reason}; it is drawn once more")
                continue
            rejected = context.layout.rejected_picture(frame)
            rejected.parent.mkdir(exist_ok=True)
            shutil.copyfile(paths[0], rejected)
            raise InvalidArtifactError(
                f"frame {frame}: the picture {error.reason}; twice; it is kept as {rejected}"
            ) from error
        return


def _draw(context: TaskContext, frame: int, paths: list[Path]) -> None:
    """Draw a frame; the first one of this process on a GPU takes what compiling takes."""
    renderer = _warm_renderer(context)
    if context.gpu is not None and renderer.device == CPU:
        context.warn(NO_GPU, f"frame {frame}: Cycles finds no GPU {context.gpu} any more; drawn on the processor")
    if renderer.device == CPU or renderer.device in _COMPILED:
        renderer.render(frame, *paths)
        return

    def tell(message: str) -> None:
        context.progress(0, 1, message, preparing=True)

    with compiled_once(renderer.device, _blender_version(context.job.render.blender), tell):
        renderer.render(frame, *paths)
    _COMPILED.add(renderer.device)
    context.progress(0, 1)


def _check_picture(context: TaskContext, frame: int, path: Path, view: View, bodies: Sequence[BodyAtFrame]) -> None:
    """Raise InvalidFileError if a picture is damaged, black, of one colour, or shows the stage without its bodies."""
    from render.pictures import read_shown, require_more_than_stage, validate_picture

    job = context.job
    validate_picture(path, job.render.resolution, may_be_empty=_may_be_empty(job))
    width, height = job.render.resolution
    scale = min(1.0, STAGE_PIXELS / max(width, height))
    columns, rows = max(4, round(scale * width)), max(4, round(scale * height))
    cells = expected_cells(job, view, bodies, (rows, columns))
    if cells is None:
        return
    if job.camera.moves or "still" not in _EMPTY_STAGE:
        with tempfile.TemporaryDirectory(prefix="stage-") as folder:
            picture = Path(folder) / "stage.png"
            _warm_renderer(context).render_stage(frame, picture, resolution=(columns, rows))
            stage = read_shown(picture)
        if not job.camera.moves:
            _EMPTY_STAGE["still"] = stage
    else:
        stage = _EMPTY_STAGE["still"]
    require_more_than_stage(path, stage, cells)


def _may_be_empty(job: Job) -> bool:
    """Whether nothing is left of a picture where no body is."""
    return job.stage.background != "stage"


def _position_after(time_s: float, pose: Mapping[str, NDArray[Any]]) -> list[float]:
    """Where a body is a short time before or after, its velocity kept [m]."""
    return [float(x) for x in pose["position"] + time_s * pose["velocity"]]


@contextmanager
def _replacing(layout: JobLayout, document: str, frame: int, attempt: int) -> Iterator[Path]:
    """A path to write a frame's document to, which then takes the place of what is there."""
    path = layout.root / document.replace("{frame}", f"{frame:06d}")
    path.parent.mkdir(exist_ok=True)
    part = path.with_name(f".{path.name}.part.{attempt}")
    yield part
    part.replace(path)


def _orientation(rotation_deg: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of rotations about the world's x, then y, then z axis: q = q_z q_y q_x."""
    (cx, sx), (cy, sy), (cz, sz) = ((cos(half), sin(half)) for half in (radians(angle) / 2 for angle in rotation_deg))
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )


_WARM: dict[str, Renderer] = {}
"""The renderer of this worker process, by the digest of its specification, thread count and GPU; at most one."""


def _warm_renderer(context: TaskContext) -> Renderer:
    from render.blender import open_renderer

    spec = render_spec(context.job, context.layout, framed_points(context.job, context.layout))
    key = digest_of(f"{context.layout.root} {context.threads} {context.gpu} {spec.model_dump_json()}")
    if key not in _WARM:
        _close_renderers()
        path = context.layout.root / "scene.json"
        part = context.layout.root / f".scene.json.part.{os.getpid()}"
        spec.write(part)
        part.replace(path)
        blender = context.job.render.blender
        _WARM[key] = open_renderer(path, threads=context.threads, blender=blender, gpu=context.gpu)
    return _WARM[key]


_COMPILED: set[str] = set()
"""The devices on which this process has drawn."""

_EMPTY_STAGE: dict[str, NDArray[np.uint8]] = {}
"""What the warm renderer draws without any body, (rows, columns, 3); kept for a camera that stands still."""


def _close_renderers() -> None:
    for renderer in _WARM.values():
        renderer.close()
    _WARM.clear()
    _EMPTY_STAGE.clear()
