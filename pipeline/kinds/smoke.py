"""Smoke: OpenVDB volumes of its grids."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.content import ABSENT, tool_version
from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.kinds.base import Change, Codec, Display, Kind, Materials, Product, SolidBuilder, Solids, Work
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.sizes import expected_cells, size_of_smoke
from pipeline.kinds.work import smoke_work
from pipeline.model.boxes import smoke_box
from pipeline.model.job import Job
from pipeline.model.looks import BODY
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.bounds import Reach, box_of_smoke, reach_of_box
from render.errors import VolumeUnavailableError
from render.parameters import MaterialParameters
from render.spec import SceneObject, VolumeSequenceObject
from render.volume import import_openvdb, validate_volume, write_volume
from sim.shapes.parameters import Placement
from sim.smoke.parameters import CELLS_PER_EDDY, SmokeParameters

if TYPE_CHECKING:
    import h5py

    from pipeline.kinds.smoke_codec import SmokeInBox

WORKER_BYTES = 130_000_000
BYTES_PER_CELL = 80
"""Of writing a volume all full of smoke, what is read from the cache included."""


def _codec() -> Codec:
    from pipeline.kinds import smoke_codec

    return smoke_codec


def _placements(job: Job, index: int) -> Iterator[tuple[KeyPath, Placement]]:
    from sim.coupling.smoke_sources import placed_on

    for number, source in enumerate(job.smoke[index].source):
        body = next((body for body in job.rigid if body.name == source.follow), None)
        yield ("source", number), source if body is None else placed_on(source, body)


def _check(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.smoke import check_smokes

    return check_smokes(job, solids, budget, findings)


def _growth(job: Job) -> Callable[[float], str | None]:
    from pipeline.kinds.checks.smoke import growth_refusal

    return growth_refusal(job)


def _coarser(job: Job, factor: float, solids: SolidBuilder | None) -> list[Change]:
    from pipeline.kinds.checks.smoke import coarser_cell_sizes

    changes: list[Change] = []
    cell_sizes = [smoke.cell_size for smoke in job.smoke]
    if job.smoke and solids is not None:
        cell_sizes = coarser_cell_sizes(job, factor, solids())
    for index, (smoke, cell_size) in enumerate(zip(job.smoke, cell_sizes, strict=True)):
        if smoke.upres > 1 and solids is not None:
            changes.append((("smoke", index, "upres"), 1))
        changes.append((("smoke", index, "cell_size"), cell_size))
        gusts = smoke.turbulence
        if gusts.strength > 0.0 and gusts.size < CELLS_PER_EDDY * cell_size:
            changes.append((("smoke", index, "turbulence", "size"), CELLS_PER_EDDY * cell_size))
    return changes


def _objects(job: Job, _layout: JobLayout, smoke: SmokeParameters, material_of: Materials) -> Iterator[SceneObject]:
    box_min, box_max = smoke.corners(job.domain)
    # Where the box has no end nothing is cut off, and nothing fades.
    ends = () if smoke.grid == "open" else smoke.open_faces
    yield VolumeSequenceObject(
        name=smoke.name,
        file=VOLUME.file_of(smoke.name),
        box_min=box_min,
        box_max=box_max,
        open_faces=ends,
        ambient_temperature=smoke.ambient_temperature,
        material=material_of(BODY),
    )


def _reach(_job: Job, _layout: JobLayout, _smoke: SmokeParameters, group: h5py.Group) -> Reach | None:
    from pipeline.kinds.smoke_codec import read_density

    box = box_of_smoke(*read_density(group))
    return None if box is None else reach_of_box(box)


# --- the volume of a frame ---


def _openvdb(_job: Job) -> dict[str, str]:
    """The package that `import_openvdb` takes the binding from, with its version."""
    provider = "openvdb" if tool_version("openvdb") != ABSENT else "bpy"
    return {provider: tool_version(provider)}


def _missing_openvdb() -> list[str]:
    try:
        import_openvdb()
    except VolumeUnavailableError as error:
        return [str(error)]
    return []


def _write_volume(path: Path, smoke: SmokeInBox, job: Job, _threads: int) -> None:
    try:
        write_volume(path, **vars(smoke), parameters=job.volume, fps=job.fps, shutter=job.render.shutter)
    except ValueError as error:
        raise InvalidArtifactError(str(error)) from error


VOLUME = Product(
    stage="volume",
    about="smoke as OpenVDB",
    version=2,
    folder="volumes",
    suffix=".vdb",
    tools=_openvdb,
    parameters=lambda job, _smoke: {"volume": job.volume, "fps": job.fps, "shutter": job.render.shutter},
    memory_bytes=lambda job, smoke: WORKER_BYTES + BYTES_PER_CELL * ceil(expected_cells(smoke, job.domain)),
    write=_write_volume,
    validate=validate_volume,
    file_bytes=lambda _smoke, cells: 20_000 + 3.0 * cells,
    work=lambda _job, _smoke, cells: Work(0.0, 0.3e-6 * cells),
    preflight=_missing_openvdb,
)

SMOKE = Kind(
    name="smoke",
    parameters=SmokeParameters,
    about="Smoke.",
    size="{:,} smoke cells",
    elements=lambda job, smoke: expected_cells(smoke, job.domain),
    snapshot_bytes=(31.0, 2.0, 30.5),
    work=smoke_work,
    solver_bytes=230.0,
    compiling_s=8.0,
    drawing=1.4,
    wears="smoke",
    material=lambda _smoke: {BODY: MaterialParameters(look="smoke")},
    look_size=size_of_smoke,
    boxes=lambda job, smoke: [smoke_box(smoke, job.domain)],
    placements=_placements,
    check=_check,
    coarser=_coarser,
    lighter="a larger smoke.cell_size",
    growth=_growth,
    codec=_codec,
    product=VOLUME,
    objects=_objects,
    reach=_reach,
    reach_bytes=8.0,
    display=Display("Smoke", "density"),
    facts=lambda smoke, _count: f"smoke, cells of {smoke.cell_size:g} m",
)
