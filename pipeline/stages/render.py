"""Render: each frame of the job, drawn by Blender's Cycles."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from math import prod, sqrt
from pathlib import Path
from typing import Any

from blender_scripts.look_table import LOOK_TABLE
from pipeline.base.content import content_name
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.job.input_files import split_blend
from pipeline.kinds.base import Work
from pipeline.kinds.rigid import is_animated, meshes_at_rest
from pipeline.kinds.table import KINDS, material_of, points_of, products_of
from pipeline.model.gpus import OWN_GPUS, known_gpus, own_gpus, render_gpus, usable_gpus
from pipeline.model.job import Job
from pipeline.model.looks import BODY, parts_of
from pipeline.model.problems import suggestion
from pipeline.stages.base import FileWork, Stage, TaskContext
from pipeline.stages.inputs import blender_version
from pipeline.stages.render_drawing import CPU, FrameDrawing, close_renderers, may_be_empty
from pipeline.stages.render_scene import framing_files, render_spec, write_motion
from pipeline.stages.texture_memory import own_picture_bytes
from pipeline.stages.visibility import bodies_at, warn_if_invisible
from render.blend_file import read_material_names
from render.blender import BlenderDiedError, BlenderUnavailableError, require_bpy, require_supported_executable
from render.camera_path import FRAMING_VERSION
from render.errors import InvalidFileError
from render.meshes import read_ply
from render.pictures import validate_exr
from render.spec import RenderSpec

CORES = 2  # threads a frame: Cycles with one keeps a second busy waiting. The pixels do not depend on it

WORKER_BYTES = 500_000_000
BYTES_PER_PIXEL = 700
"""Measured peaks of the quickstart with denoising, Blender included: 538 MB at 480 x 270 and 1880 MB at 1920 x 1080."""

SAMPLES = {"draft": 6, "preview": 48, "final": 256}
"""Most samples of a pixel by quality, as `blender_scripts.settings` has them; a test holds them together."""
FULL_SAMPLES = 48
"""Beyond so many samples most pixels have had enough: the mean grows with the root."""
SAMPLE_S, GPU_SAMPLE_S = 4e-6, 0.04e-6
"""Time of a sample of a pixel in a scene of one fluid: of a core of the reference machine, and of an H200 [s]."""
FRAME_S, GPU_FRAME_S = 3.0, 2.0
"""Time of a picture besides: building the scene, denoising, writing and checking [s]."""
START_S = 10.0
"""Time of Blender's start and of the first picture's kernels [s]."""
EMPTY_SET = 0.4
"""What ground, sky and lights take of the time of a scene of one fluid, besides what is in it [-]."""
VOLUME_FACTORS = {"draft": 1.0, "preview": 2.0, "final": 5.0}
"""What volumes take more where light is scattered in them, by quality [-]."""

COMBINED = "ViewLayer.Combined"  # Blender's name for the picture's layer among passes

BYTES_PER_PIXEL_AND_PASS = 200  # the largest, cryptomatte, has 24 floats a pixel, in Cycles and in what is saved

_WITHOUT_EFFECT_ON_PIXELS: dict[str, Any] = {"version": True, "engine": True, "render": {"blender", "order"}}
"""The film is always of Cycles. The executable counts by its version. The device does count: CPU and GPU round
differently."""

FLAT_PICTURES = "flat pictures"


class RenderStage(Stage):
    """One PNG a frame, and an EXR if the job asks for one. A worker keeps Blender and the scene warm between frames."""

    name = "render"
    about = "pictures"
    draws = True
    version = 4

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame."""
        drawn = render_spec(job, layout)
        spec = decisive(drawn)
        if job.camera.frames_action:
            # Where it is follows from these and from the box that it frames, which is an input.
            spec["camera"] = {"framing": job.placed_camera.model_dump(mode="json"), "version": FRAMING_VERSION}
        elif job.placed_camera.moves:
            spec["camera"]["path"] = job.placed_camera.model_dump(mode="json", exclude={"framing"})
        parameters = ParameterSet.of(
            spec,
            stage=self.name,
            version=self.version,
            tools={"blender": blender_version(job.render.blender)},
        )
        bytes_per_pixel = BYTES_PER_PIXEL + BYTES_PER_PIXEL_AND_PASS * len(job.render.passes)
        renderer_bytes = WORKER_BYTES + own_picture_bytes(drawn)
        resources = Resources(
            cores=CORES,
            memory_bytes=renderer_bytes + bytes_per_pixel * prod(job.render.resolution),
            gpus=int(_draws_on_gpus(job)),
        )
        static = [*meshes_at_rest(job.rigid), *framing_files(job, layout)]
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

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """By pixels, samples and what takes the longest of what is drawn."""
        there = [kind for kind in KINDS.values() if kind.bodies(job)]
        content = EMPTY_SET + max((kind.drawing for kind in there), default=0.0)
        samples = effective_samples(job.render.quality, job.render.samples)
        seconds = prod(job.render.resolution) * samples * content * (GPU_SAMPLE_S if on_gpu else SAMPLE_S)
        seconds *= VOLUME_FACTORS[job.render.quality] if any(kind.drawing > 1.0 for kind in there) else 1.0
        what = "+".join([job.render.quality, *(kind.name for kind in there if kind.drawing)])
        return FileWork(what, Work(seconds, GPU_FRAME_S if on_gpu else FRAME_S), START_S)

    def preflight(self, job: Job) -> list[str]:
        """No Blender, one that is too old or lacks a shared library, or one without the material or GPU asked for."""
        try:
            if job.render.blender is None:
                require_bpy()
            else:
                require_supported_executable(job.render.blender)
            return [*_missing_materials(job), *_missing_gpus(job)]
        except BlenderUnavailableError as error:
            return [str(error)]

    def lighter(self, job: Job) -> str:  # noqa: ARG002
        """Fewer pixels; what is drawn is the bodies' matter."""
        return "a smaller render.resolution"

    def run(self, context: TaskContext) -> None:
        """Draw one frame."""
        task, job, layout = context.task, context.job, context.layout
        assert task.frame is not None
        poses, view = write_motion(job, layout, task.frame, attempt=context.attempt)
        bodies = list(bodies_at(job, layout, task.frame, poses))
        warn_if_invisible(context, view, bodies)
        drawing = FrameDrawing(context, view, bodies)

        def validate_master(path: Path) -> None:
            layer = COMBINED if job.render.passes else ""
            validate_exr(path, job.render.resolution, layer=layer, may_be_empty=may_be_empty(job))

        try:
            with ExitStack() as stack:
                device = drawing.renderer.device
                if task.frame == 0:
                    _warn_of_flat_pictures(context, drawing.renderer.pictures_by_uv)
                print(f"Cycles draws on {device}{'' if device == CPU else f', GPU {context.gpu}'}", flush=True)
                masters = [
                    stack.enter_context(context.committing(output, validate_master, device=device))
                    for output in task.outputs[1:]
                ]
                picture = stack.enter_context(
                    context.committing(task.outputs[0], drawing.require_checked, device=device)
                )
                drawing.draw_until_good(picture, masters)
        except BlenderDiedError:
            close_renderers()  # the next attempt, maybe in this process, needs a living one
            raise
        layout.rejected_picture(task.frame).unlink(missing_ok=True)
        context.progress(1, 1)


def effective_samples(quality: str, samples: int | None) -> float:
    """Mean samples of a pixel, fewer than the most that it may have where noise is soon gone."""
    most = samples or SAMPLES[quality]
    return min(most, FULL_SAMPLES) * sqrt(max(1.0, most / FULL_SAMPLES))


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

    Raises BlenderUnavailableError: Blender does not answer.
    """
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


def decisive(spec: RenderSpec) -> dict[str, Any]:
    """The part of a specification that decides pixels, files named by their content.

    Raises MissingInputError: a file cannot be read.
    """
    document = spec.model_dump(mode="json", exclude=_WITHOUT_EFFECT_ON_PIXELS)
    document["render"]["passes"].sort()  # their order changes nothing
    backdrop = document["set"]
    if spec.set.hdri is not None:
        backdrop["hdri"] = content_name(spec.set.hdri, "picture")
        backdrop["name"] = None  # its light and sky are not there
    else:
        del backdrop["rotation_deg"]  # there is nothing to turn
    if spec.set.backplate is not None:
        backdrop["backplate"] = content_name(spec.set.backplate, "picture")
    else:
        del backdrop["backplate"]
    # Where a pane is left out; the tank has none above or below.
    document["open_faces"] = sorted({face for face in spec.open_faces if face[0] in "xy"}) if backdrop["tank"] else []
    for drawn in document["objects"]:
        material = drawn["material"]
        if material["blend"] is not None:
            file, name = split_blend(material["blend"])
            drawn["material"] = {"blend": f"{content_name(file, '.blend file')}:{name}"}  # it says all
        elif material["look"] is not None:
            material["look_revision"] = LOOK_TABLE[material["look"]].revision
        if material["look"] is None or not LOOK_TABLE[material["look"]].fits_sheets:
            drawn.pop("edges", None)  # nothing of it is scaled by them
    return document


def _warn_of_flat_pictures(context: TaskContext, pictures_by_uv: Collection[str]) -> None:
    """Warn of pictures in .blend materials on what has no texture coordinates: all of it takes one colour of them.

    `pictures_by_uv` are names of objects with pictures that lie by texture coordinates, as the renderer found them.
    """
    for name, blend in _without_coordinates(context.job, context.layout):
        if name in pictures_by_uv:
            context.warn(
                FLAT_PICTURES,
                f'"{name}" has no texture coordinates, so pictures in its material "{split_blend(blend)[1]}" show one '
                "colour; give it a mesh file with a UV map, or let the material use generated or object coordinates",
            )


def _without_coordinates(job: Job, layout: JobLayout) -> Iterator[tuple[str, str]]:
    """Objects with a .blend material and no texture coordinates: their names, and `file.blend:Name`."""
    for body in job.rigid:
        for part in parts_of(body.shape):
            material = material_of(job, body.name, part)
            if material.blend is None:
                continue
            if is_animated(body) or read_ply(layout.path(layout.body_mesh(body.model, part))).corner_uv is None:
                yield body.name if part == BODY else f"{body.name}.{part}", material.blend
    for fluid in job.fluid:
        if (blend := material_of(job, fluid.name).blend) is not None:
            yield fluid.name, blend


def _frame_inputs(job: Job, layout: JobLayout, frame: int) -> list[ArtifactPath]:
    products = [path for _, _, path in products_of(job, layout, frame)]
    points = points_of(job, layout, frame)
    # The cache changes with every change of the simulation, so it is an input only where something of it is drawn.
    cached = [layout.frame_cache(frame)] if job.moving_bodies or not products else []
    return products + points + cached
