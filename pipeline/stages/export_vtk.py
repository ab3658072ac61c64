"""Export for ParaView and other programs of VTK: every array of every body, one time series."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId
from pipeline.kinds.fluid import FLUID
from pipeline.kinds.rigid import is_animated, meshes_at_rest
from pipeline.kinds.soft import SOFT, is_grainy
from pipeline.kinds.stored_arrays import unit_of
from pipeline.kinds.table import bodies, points_of, products_of
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from pipeline.stages.export import ExportStage, frame_of
from pipeline.store.cache import read_compact
from render.meshes import read_ply
from render.point_clouds import read_point_cloud
from render.vtk_files import Values, validate_vtk, write_blocks, write_grid, write_polydata, write_series
from sim.core.motion.rotation import rotated

FOLDER = "vtk"


class VtkExport(ExportStage):
    """Files of each frame: particles, surfaces, drops, cloths, bodies where they are, cells of smoke; one series."""

    format = "vtk"
    version = 2
    about = "ParaView's files"
    opened_by = "open {file} in ParaView (paraview {file})"

    def root(self, job: Job) -> ArtifactPath:
        """ParaView's own ending."""
        return ArtifactPath(f"{job.name}.pvd")

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame, and one for the series."""
        parameters = ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={},
        )
        meshes = meshes_at_rest(job.rigid)
        tasks = []
        for frame in self.chosen(job):
            surfaces = _surfaces(job, layout, frame).values()
            blocks = [file for _, file in _blocks(job, layout, frame)]
            tasks.append(
                Task(
                    id=TaskId(f"{self.name}/{frame:06d}"),
                    stage=self.name,
                    inputs=(layout.frame_cache(frame), *meshes, *surfaces, *points_of(job, layout, frame)),
                    outputs=(*blocks, _frame_file(frame)),
                    parameters=parameters,
                    frame=frame,
                )
            )
        series = Task(
            id=TaskId(f"{self.name}/series"),
            stage=self.name,
            inputs=tuple(task.outputs[-1] for task in tasks),
            outputs=(self.root(job),),
            parameters=ParameterSet.of(stage=self.name, version=self.version, tools={}, fps=job.fps),
        )
        return [*tasks, series]

    def left_out(self, job: Job) -> list[str]:
        """Grains of soft matter, whose particles are there."""
        return [f"grains ({each.name})" for each in job.soft if is_grainy(each)]

    def run(self, context: TaskContext) -> None:
        """Write the files of a frame, or the series."""
        task, job = context.task, context.job
        if task.frame is None:
            with context.committing(task.outputs[0], validate_vtk) as path:
                write_series(path, [(frame_of(each) / job.fps, str(each)) for each in task.inputs])
        else:
            _Frame(job, context.layout, task.frame).write(context)
        context.progress(1, 1)


def _frame_file(frame: int) -> ArtifactPath:
    return ArtifactPath(f"{FOLDER}/{frame:06d}.vtm")


def _surfaces(job: Job, layout: JobLayout, frame: int) -> dict[str, ArtifactPath]:
    """Files of the surfaces around particles, of fluids and of soft matter that has no grains, by body."""
    return {
        body.name: file
        for kind, body, file in products_of(job, layout, frame)
        if kind is FLUID or (kind is SOFT and not is_grainy(body))
    }


def _blocks(job: Job, layout: JobLayout, frame: int) -> list[tuple[str, ArtifactPath]]:
    """Names of a frame's blocks, and their files."""
    blocks, surfaces = [], _surfaces(job, layout, frame)
    for _, kind, body in bodies(job):
        suffix = "vti" if kind.display.form == "density" else "vtp"
        blocks.append((body.name, suffix))
        if body.name in surfaces:
            blocks.append((f"{body.name}.surface", "vtp"))
        if kind is FLUID:
            blocks.append((f"{body.name}.drops", "vtp"))
        if body.name in job.whitewater:
            blocks.append((f"{body.name}.whitewater", "vtp"))
    return [(name, ArtifactPath(f"{FOLDER}/{name}/{frame:06d}.{suffix}")) for name, suffix in blocks]


class _Frame:
    """The files of one frame."""

    def __init__(self, job: Job, layout: JobLayout, frame: int) -> None:
        self._job, self._layout, self._frame = job, layout, frame
        self._time_s = frame / job.fps
        self._cache = layout.path(layout.frame_cache(frame))

    def write(self, context: TaskContext) -> None:
        """Commit every block, then what names them."""
        writers = dict(self._writers())
        blocks = _blocks(self._job, self._layout, self._frame)
        for name, artifact in blocks:
            with context.committing(artifact, validate_vtk) as path:
                writers[name](path)
        with context.committing(_frame_file(self._frame), validate_vtk) as path:
            write_blocks(path, [(name, str(artifact).removeprefix(f"{FOLDER}/")) for name, artifact in blocks])

    def _writers(self) -> Iterator[tuple[str, Callable[[Path], None]]]:
        of_form = {"mesh": self._mesh, "parts": self._parts, "density": self._cells}
        surfaces = _surfaces(self._job, self._layout, self._frame)
        for _, kind, body in bodies(self._job):
            if kind.display.form == "points":
                yield body.name, partial(self._points, body=body, radius=kind.display.radius)
            else:
                yield body.name, partial(of_form[kind.display.form], body=body)
            if body.name in surfaces:
                yield f"{body.name}.surface", partial(self._surface, file=surfaces[body.name])
            if kind is FLUID:
                drops = self._layout.drops(body.name, self._frame)
                yield f"{body.name}.drops", partial(self._cloud, file=drops, fades=False)
            if body.name in self._job.whitewater:
                whitewater = self._layout.whitewater(body.name, self._frame)
                yield f"{body.name}.whitewater", partial(self._cloud, file=whitewater, fades=True)

    def _points(self, path: Path, *, body: Any, radius: str) -> None:
        snapshot = read_compact(self._cache, body.name)
        arrays = dict(snapshot.arrays)
        position = arrays.pop("position")
        values = {key: Values(array, unit_of(snapshot.kind, key)) for key, array in arrays.items()}
        radii = np.full(len(position), snapshot.number(radius), np.float32)
        write_polydata(path, position, point_values={**values, "radius": Values(radii, "m")}, time_s=self._time_s)

    def _mesh(self, path: Path, *, body: Any) -> None:
        snapshot = read_compact(self._cache, body.name)
        arrays = dict(snapshot.arrays)
        position, triangles = arrays.pop("position"), arrays.pop("triangles")
        values = {key: Values(array, unit_of(snapshot.kind, key)) for key, array in arrays.items()}
        write_polydata(path, position, triangles=triangles, point_values=values, time_s=self._time_s)

    def _parts(self, path: Path, *, body: Any) -> None:
        if is_animated(body):
            arrays = read_compact(self._cache, body.name).arrays
            led = {"velocity": Values(arrays["vertex_velocities"], "m/s")}
            write_polydata(
                path, arrays["vertices"], triangles=arrays["triangles"], point_values=led, time_s=self._time_s
            )
            return
        meshes = [read_ply(self._layout.path(mesh)) for mesh in meshes_at_rest([body])]
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        rest = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float64)
        triangles = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
        part = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        pose = read_compact(self._cache, body.name).arrays
        position, orientation, velocity, spin = (
            np.asarray(pose[key], np.float64) for key in ("position", "orientation", "velocity", "angular_velocity")
        )
        arms = rotated(orientation, rest)
        speeds = (velocity + np.cross(spin, arms)).astype(np.float32)
        write_polydata(
            path,
            position + arms,
            triangles=triangles,
            point_values={"velocity": Values(speeds, "m/s")},
            cell_values={"part": Values(part, "1")},
            time_s=self._time_s,
        )

    def _cells(self, path: Path, *, body: Any) -> None:
        smoke = read_compact(self._cache, body.name)
        values = {
            "density": Values(smoke.density, "1"),
            "temperature": Values(smoke.temperature, "K"),
            "velocity": Values(smoke.velocity, "m/s"),
        }
        write_grid(
            path,
            values,
            first_cell=smoke.first_cell,
            origin=smoke.origin,
            cell_size=smoke.cell_size,
            time_s=self._time_s,
        )

    def _surface(self, path: Path, *, file: ArtifactPath) -> None:
        mesh = read_ply(self._layout.path(file))
        values = {
            key: Values(array, unit)
            for key, array, unit in (
                ("velocity", mesh.velocities, "m/s"),
                ("normals", mesh.normals, "1"),
                ("dye", None if mesh.dye is None else mesh.dye[:, 0], "1"),
            )
            if array is not None
        }
        write_polydata(path, mesh.vertices, triangles=mesh.faces, point_values=values, time_s=self._time_s)

    def _cloud(self, path: Path, *, file: ArtifactPath, fades: bool) -> None:
        cloud = read_point_cloud(self._layout.path(file))
        values = {"velocity": Values(cloud.velocity, "m/s"), "radius": Values(cloud.radius, "m")}
        if fades:
            values |= {"lifetime": Values(cloud.lifetime, "s"), "kind": Values(cloud.kind, "1")}
        write_polydata(path, cloud.position, point_values=values, time_s=self._time_s)
