"""Cloth: sheets of triangles."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.kinds.base import Change, Display, Kind, Materials, Product, SolidBuilder, Solids, Work
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.elements import count_nodes, sheet_of
from pipeline.kinds.live_parameters import CLOTH_LIVE
from pipeline.kinds.sizes import boxes_of_sheet, size_of_sheet
from pipeline.kinds.work import cloth_work
from pipeline.model.job import Job
from pipeline.model.looks import BODY
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.bounds import Reach, reach_of_points
from render.cloth import vertex_normals
from render.meshes import validate_ply, write_ply
from render.parameters import MaterialParameters
from render.spec import MeshSequenceObject, SceneObject
from sim.cloth.parameters import ClothParameters, Material, RectangleSheet
from sim.core.snapshots import Snapshot

if TYPE_CHECKING:
    import h5py


BASE_BYTES = 250_000_000
"""Interpreter, numpy and h5py."""
BYTES_PER_NODE = 600
"""The frame's arrays, the normals of its triangles and the mesh as it is written."""

LOOKS: dict[Material, MaterialParameters] = {
    "cotton": MaterialParameters(look="cotton"),
    "silk": MaterialParameters(look="silk"),
    "denim": MaterialParameters(look="denim"),
    "rubber": MaterialParameters(look="rubber", color=(0.03, 0.03, 0.035)),
}
"""By what a cloth is made of."""


def _check(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.cloth import check_cloths

    return check_cloths(job, solids, budget, findings)


def _coarser(job: Job, factor: float, _solids: SolidBuilder | None) -> list[Change]:
    changes: list[Change] = []
    for index, cloth in enumerate(job.cloth):
        # Pins would hold others in a coarser sheet where they name nodes by number, and others or none in a region.
        by_place = all(pin.index is None and pin.region is None for pin in cloth.pin)
        if isinstance(cloth.shape, RectangleSheet) and by_place:
            changes.append(_coarser_sheet(("cloth", index, "shape"), cloth.shape, factor))
    return changes


def _coarser_sheet(path: KeyPath, sheet: RectangleSheet, factor: float) -> Change:
    if sheet.counts is None:
        assert sheet.resolution is not None
        return (*path, "resolution"), sheet.resolution * factor
    return (*path, "counts"), [max(2, round((count - 1) / factor) + 1) for count in sheet.counts]


def _objects(_job: Job, _layout: JobLayout, cloth: ClothParameters, material_of: Materials) -> Iterator[SceneObject]:
    yield MeshSequenceObject(
        name=cloth.name, file=MESH.file_of(cloth.name), material=material_of(BODY), edges=sheet_of(cloth).edges
    )


def _reach(_job: Job, _layout: JobLayout, _cloth: ClothParameters, group: h5py.Group) -> Reach | None:
    return reach_of_points(group["position"][()])


def _write_mesh(path: Path, cloth: Snapshot, _job: Job, _threads: int) -> None:
    arrays = cloth.arrays
    write_ply(
        path,
        arrays["position"],
        arrays["triangles"],
        normals=vertex_normals(arrays["position"], arrays["triangles"]),
        velocities=arrays["velocity"],
        uv=arrays["uv"],
    )


MESH = Product(
    stage="cloth",
    about="meshes of cloths",
    version=1,
    folder="cloths",
    suffix=".ply",
    tools=lambda _job: {"numpy": tool_version("numpy")},
    memory_bytes=lambda _job, cloth: BASE_BYTES + BYTES_PER_NODE * count_nodes(cloth),
    write=_write_mesh,
    validate=validate_ply,
    file_bytes=lambda _cloth, nodes: 70.0 * nodes,
    work=lambda _job, _cloth, nodes: Work(0.0, 2.0e-6 * nodes),
)

CLOTH = Kind(
    name="cloth",
    parameters=ClothParameters,
    about="Cloths; they collide with each other, and share the keys that say how they step.",
    size="{:,} cloth nodes",
    elements=lambda _job, cloth: count_nodes(cloth),
    snapshot_bytes=(60.0, 32.0, 54.0),
    work=cloth_work,
    solver_bytes=4_000.0,
    compiling_s=90.0,
    drawing=0.4,
    wears="cloth",
    material=lambda cloth: {BODY: LOOKS[cloth.material]},
    look_size=size_of_sheet,
    boxes=boxes_of_sheet,
    check=_check,
    coarser=_coarser,
    lighter="fewer nodes of a cloth.shape",
    shares_solver=lambda _cloth: True,
    is_closed=False,
    product=MESH,
    objects=_objects,
    reach=_reach,
    reach_bytes=100.0,
    display=Display("Cloth", "mesh"),
    live=CLOTH_LIVE,
    facts=lambda cloth, _count: f"cloth of {cloth.material}, {cloth.mass_per_area:g} kg/m²",
)
