"""Bodies: the mesh of each rigid body in its rest pose, for the renderer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from blender_scripts.look_table import LOOK_TABLE
from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Task, TaskId
from pipeline.kinds.base import Work
from pipeline.kinds.rigid import is_animated
from pipeline.kinds.table import material_of
from pipeline.model.job import Job
from pipeline.model.looks import parts_of
from pipeline.stages.base import FileWork, Stage, TaskContext
from pipeline.stages.inputs import by_content
from render.meshes import validate_ply, write_ply
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import TriangleMesh

if TYPE_CHECKING:
    from sim.shapes.placement import PlacedSolid

MESH_S = 2.0
"""Time of meshing a body, its worker's start included [s]."""
EDGE_IN_RADII = 1.5
"""Longest edge of a body that light goes through, in radii of a fluid's particles: its vertices tell where the fluid
covers it (`blender_scripts.wetting`)."""
MOST_TRIANGLES = 500_000
"""How many such a body has at most, but for those of its file: a larger one has a coarser line where the fluid ends."""


class BodiesStage(Stage):
    """One PLY per rigid body and part of its shape, in its rest pose, wherever it stands in the scene.

    Bodies of a group that are of one size have one together, that of the first of them.
    """

    name = "bodies"
    about = "meshes of rigid bodies"
    version = 3

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a body that is not another's copy."""
        return [
            Task(
                id=TaskId(f"bodies/{body.name}"),
                stage=self.name,
                inputs=(),
                outputs=tuple(layout.body_mesh(body.name, part) for part in parts_of(body.shape)),
                parameters=ParameterSet.of(
                    stage=self.name,
                    version=self.version,
                    tools={name: tool_version(name) for name in ("libigl", "trimesh")},
                    shape=by_content(body).shape,
                    scale=body.scale,
                    **({"textured": True} if _is_textured(job, body) else {}),
                    **({"longest_edge": edge} if (edge := _longest_edge(job, body)) is not None else {}),
                ),
                subject=body.name,
            )
            for body in job.rigid
            if body.is_own_model and not is_animated(body)
        ]

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """A mesh of a shape."""
        return FileWork("mesh", Work(0.0, MESH_S))

    def run(self, context: TaskContext) -> None:
        """Mesh one body."""
        from sim.shapes.mesh_file import texture_coordinates
        from sim.shapes.placement import build_solid

        parameters = next(body for body in context.job.rigid if body.name == context.task.subject)
        solid = build_solid(parameters)
        edge = _longest_edge(context.job, parameters)
        mesh = solid.rest_mesh() if edge is None else mesh_within(solid, edge, most=MOST_TRIANGLES)
        shape, uv = parameters.shape, None
        if isinstance(shape, MeshShape) and _is_textured(context.job, parameters):
            at_own_size = TriangleMesh(mesh.vertices / parameters.scale, mesh.faces)
            uv = texture_coordinates(at_own_size, shape)
        for part, output in zip(parts_of(parameters.shape), context.task.outputs, strict=True):
            piece = mesh.piece(part)
            with context.committing(output, validate_ply) as path:
                write_ply(path, piece.vertices, piece.faces, corner_uv=uv)
        context.progress(1, 1)


def mesh_within(solid: PlacedSolid, max_edge: float, *, most: int) -> TriangleMesh:
    """The surface of a solid at rest with edges of at most `max_edge` [m], or as fine as so many triangles can be.

    Edges are shortened step by step: how many triangles an edge makes depends on the shape, so that none is made that
    has many more. If they do not suffice, edges are up to about sqrt(2) longer than they could be.
    """
    from sim.shapes.tessellation import longest_edge

    mesh = solid.rest_mesh()
    edge = longest_edge(mesh)
    while edge > max_edge:
        edge = max(max_edge, edge / 2.0**0.5)
        finer = solid.rest_mesh(edge)
        if len(finer.faces) > most:
            break
        mesh = finer
    return mesh


def _longest_edge(job: Job, body: RigidBodyParameters) -> float | None:
    """Longest edge that its mesh may have [m], if it is one that fluids are seen through."""
    if not job.fluid or not any(_refracts(job, each) for each in _copies(job, body)):
        return None
    return EDGE_IN_RADII * min(fluid.particle_radius for fluid in job.fluid)


def _is_textured(job: Job, body: RigidBodyParameters) -> bool:
    """Whether its file's texture coordinates are kept: a material of a .blend file may hang pictures on them."""
    if not isinstance(body.shape, MeshShape):
        return False
    return any(material_of(job, each.name).blend is not None for each in _copies(job, body))


def _refracts(job: Job, body: RigidBodyParameters) -> bool:
    look = material_of(job, body.name).look
    return look is not None and LOOK_TABLE[look].refracts


def _copies(job: Job, body: RigidBodyParameters) -> list[RigidBodyParameters]:
    """The bodies that have its mesh, itself first."""
    return [body] if body.group == body.name else [each for each in job.rigid if each.model == body.name]
