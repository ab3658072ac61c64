"""Embers: points that glow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.kinds.base import Display, Kind, Materials, Product, Solids, Work
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.model.job import Job
from pipeline.model.looks import BODY
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.parameters import MaterialParameters
from render.point_clouds import PointCloud, validate_point_cloud, write_point_cloud
from render.spec import PointSequenceObject, SceneObject
from sim.core.snapshots import Snapshot
from sim.embers.parameters import EmberParameters
from sim.shapes.parameters import Placement

BASE_BYTES, BYTES_PER_EMBER = 100_000_000, 200
"""Of a task that makes a file."""


def _placements(job: Job, index: int) -> Iterator[tuple[KeyPath, Placement]]:
    for number, source in enumerate(job.embers[index].source):
        yield ("source", number), source


def _check(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.embers import check_embers

    return check_embers(job, solids, budget, findings)


def _objects(_job: Job, _layout: JobLayout, embers: EmberParameters, material_of: Materials) -> Iterator[SceneObject]:
    file = POINTS.file_of(embers.name)
    yield PointSequenceObject(name=embers.name, file=file, kind="spray", material=material_of(BODY))


def _write(path: Path, embers: Snapshot, _job: Job, _threads: int) -> None:
    arrays, count = embers.arrays, len(embers.arrays["position"])
    cloud = PointCloud(
        position=arrays["position"].astype(np.float32),
        velocity=arrays["velocity"].astype(np.float32),
        radius=0.5 * arrays["diameter"].astype(np.float32),
        lifetime=np.ones(count, np.float32),
        kind=np.zeros(count, np.uint8),
        temperature=arrays["temperature"].astype(np.float32),
    )
    write_point_cloud(path, cloud)


POINTS = Product(
    stage="embers",
    about="embers as points",
    version=1,
    folder="embers",
    suffix=".ply",
    tools=lambda _job: {"numpy": tool_version("numpy")},
    memory_bytes=lambda _job, embers: BASE_BYTES + BYTES_PER_EMBER * embers.most,
    write=_write,
    validate=validate_point_cloud,
    file_bytes=lambda _embers, count: 37.0 * count,
    work=lambda _job, _embers, count: Work(0.0, 1.0e-6 * count),
)

EMBERS = Kind(
    name="embers",
    parameters=EmberParameters,
    about="Embers that the air of a smoke carries.",
    size="up to {:,} embers",
    elements=lambda _job, embers: float(embers.most),
    snapshot_bytes=(80.0, 36.0, 40.0),
    work=lambda _job, embers, _on_gpu: Work(0.0, 5.0e-3 + 2.0e-7 * embers),
    solver_bytes=80.0,
    compiling_s=1.0,
    drawing=0.1,
    wears="embers",
    material=lambda _embers: {BODY: MaterialParameters(look="embers")},
    placements=_placements,
    check=_check,
    lighter="a smaller embers.source.rate",
    product=POINTS,
    objects=_objects,
    reach=lambda _job, _layout, _embers, _group: None,
    display=Display("Embers", "points"),
    facts=lambda embers, count: (
        f"embers of {1e3 * embers.diameter:g} mm, which fall at {embers.fall_speed:.2g} m/s"
        + ("" if count is None else f", {count:,.0f} glowing")
    ),
)
