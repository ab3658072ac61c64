"""Export as Universal Scene Description: a scene for Houdini, Maya, Blender, Omniverse and others."""

from __future__ import annotations

from pathlib import Path

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId
from pipeline.kinds.base import Kind
from pipeline.kinds.rigid import meshes_at_rest
from pipeline.kinds.table import bodies, drawn_bodies, material_of, points_of, products_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.export import ExportStage, frame_of, motion, read_meshes
from pipeline.stages.render_scene import framed_points, framing_files, render_spec
from pipeline.store.cache import read_compact
from render.meshes import read_ply
from render.point_clouds import KINDS, drawn_radii, read_point_cloud
from render.spec import MeshObject, MeshSequenceObject, MovingMeshObject, PointSequenceObject, RenderSpec
from render.usd_files import RESERVED, WORLD, Points, prim_name, validate_usd, write_usd_frame, write_usd_scene

FOLDER = "usd"
MANIFEST = ArtifactPath(f"{FOLDER}/manifest.usda")


class UsdExport(ExportStage):
    """A layer of each frame with what changes shape, and the scene that plays them."""

    format = "usd"
    version = 3
    about = "layers of USD"
    opened_by = "open {file} in any program of USD: Houdini, Maya, usdview, in Blender File > Import > USD"
    refers_to = ("volumes",)

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame, and one for the scene."""
        tools = {"usd-core": tool_version("usd-core")}
        spec = render_spec(job, layout)
        of_frames = ParameterSet.of(
            stage=self.name, version=self.version, tools=tools, objects=[each.name for each in _changing(spec)]
        )
        tasks = []
        for frame in self.chosen(job):
            products = [path for _, _, path in products_of(job, layout, frame) if not path.startswith("volumes/")]
            points = points_of(job, layout, frame)
            tasks.append(
                Task(
                    id=TaskId(f"{self.name}/{frame:06d}"),
                    stage=self.name,
                    inputs=(*products, *points, *([layout.frame_cache(frame)] if _particles(job) else ())),
                    outputs=(ArtifactPath(f"{FOLDER}/{frame:06d}.usdc"),),
                    parameters=of_frames,
                    frame=frame,
                )
            )
        frames = self.chosen(job)
        volumes = [
            path for frame in frames for _, _, path in products_of(job, layout, frame) if path.startswith("volumes/")
        ]
        poses = [layout.frame_cache(frame) for frame in frames] if job.moving_bodies or job.placed_camera.moves else []
        scene = Task(
            id=TaskId(f"{self.name}/scene"),
            stage=self.name,
            inputs=(
                *(task.outputs[0] for task in tasks),
                *volumes,
                *poses,
                *meshes_at_rest(job.rigid),
                *(layout.product("cloths", cloth.name, frames[0], ".ply") for cloth in job.cloth),
                *framing_files(job, layout),
            ),
            outputs=(MANIFEST, self.root(job)),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools=tools,
                spec=spec.model_dump(mode="json", exclude={"set", "lights"}),
                camera=job.placed_camera.model_dump(mode="json"),
            ),
        )
        return [*tasks, scene]

    def preflight(self, job: Job) -> list[str]:
        """No library of USD, and names that would be one there."""
        if tool_version("usd-core") == "absent":
            return ["USD is written by the package usd-core; install it: pip install usd-core"]
        drawn = [each.name for _, _, each in drawn_bodies(job, JobLayout(Path()))]
        names: dict[str, list[str]] = {}
        for name in (*RESERVED, *drawn, *(particles for _, _, particles in _particles(job))):
            names.setdefault(prim_name(name), []).append(name)
        return [
            f"{' and '.join(theirs)} would both be {WORLD}/{prim} in USD, whose names have letters, digits and _; "
            "give one another name"
            for prim, theirs in names.items()
            if len(theirs) > 1
        ]

    def run(self, context: TaskContext) -> None:
        """Write the layer of a frame, or the scene."""
        if context.task.frame is None:
            _write_scene(context)
        else:
            _write_frame(context, context.task.frame)
        context.progress(1, 1)


def _changing(spec: RenderSpec) -> list[MeshSequenceObject | PointSequenceObject]:
    return [each for each in spec.objects if isinstance(each, MeshSequenceObject | PointSequenceObject)]


def _particles(job: Job) -> list[tuple[Kind, str, str]]:
    """Bodies of points: their kind and name, and what their particles are called."""
    return [
        (kind, body.name, f"{body.name}.particles") for _, kind, body in bodies(job) if kind.display.form == "points"
    ]


def _write_frame(context: TaskContext, frame: int) -> None:
    job, layout = context.job, context.layout
    meshes, points = {}, {}
    for each in _changing(render_spec(job, layout)):
        file = layout.root / each.file.replace("{frame}", f"{frame:06d}")
        if isinstance(each, MeshSequenceObject):
            meshes[each.name] = read_ply(file)
            continue
        cloud = read_point_cloud(file)
        of_kind = cloud.kind == KINDS.index(each.kind)
        radii = drawn_radii(cloud.radius[of_kind], cloud.lifetime[of_kind])
        points[each.name] = Points(cloud.position[of_kind], cloud.velocity[of_kind], radii)
    guides = {name: (kind, body) for kind, body, name in _particles(job)}
    for name, (kind, body) in guides.items():
        snapshot = read_compact(layout.path(layout.frame_cache(frame)), body)
        arrays = snapshot.arrays
        radius = snapshot.number(kind.display.radius)
        points[name] = Points(
            arrays["position"], arrays["velocity"], [radius] * len(arrays["position"]), arrays.get("particle_id")
        )
    with context.committing(context.task.outputs[0], validate_usd) as path:
        write_usd_frame(path, frame, meshes=meshes, points=points, guides=list(guides))


def _write_scene(context: TaskContext) -> None:
    job, layout, task = context.job, context.layout, context.task
    spec = render_spec(job, layout, framed_points(job, layout))
    layers = {frame_of(each): each for each in task.inputs if each.startswith(f"{FOLDER}/")}
    bodies_at_rest = [each for each in spec.objects if isinstance(each, MeshObject | MovingMeshObject)]
    meshes = read_meshes(layout, {each.name: each.file for each in bodies_at_rest})
    for each in spec.objects:
        if isinstance(each, MeshSequenceObject) and each.name in {cloth.name for cloth in job.cloth}:
            meshes[each.name] = read_ply(layout.root / each.file.replace("{frame}", f"{min(layers):06d}"))
    placements, views = motion(context, spec, layers)
    with (
        context.committing(MANIFEST, validate_usd) as manifest,
        context.committing(task.outputs[1], validate_usd) as path,
    ):
        write_usd_scene(
            path,
            manifest,
            spec,
            frames=layers,
            meshes=meshes,
            placements=placements,
            views=views,
            guides={name: material_of(job, body) for _, body, name in _particles(job)},
            manifest_name=MANIFEST,
            first_layer=layout.path(layers[min(layers)]),
        )
