"""The shapes of a job, each with its place in the file."""

from __future__ import annotations

from collections.abc import Iterator

from pipeline.job.models import Job
from pipeline.job.positions import KeyPath
from sim.shapes.parameters import MeshShape, Placement
from sim.smoke.parameters import SmokeSourceParameters


def placements(job: Job) -> Iterator[tuple[KeyPath, Placement]]:
    """Every solid that stands in the scene, with the path of its table."""
    for index, body in enumerate(job.rigid):
        yield ("rigid", index), body
    for index, fluid in enumerate(job.fluid):
        for number, block in enumerate(fluid.block):
            yield ("fluid", index, "block", number), block
    for index, smoke in enumerate(job.smoke):
        for number, source in enumerate(smoke.source):
            yield ("smoke", index, "source", number), _at_the_start(job, source)


def _at_the_start(job: Job, source: SmokeSourceParameters) -> SmokeSourceParameters:
    """A source on a body stands where that does."""
    body = next((body for body in job.rigid if body.name == source.follow), None)
    if body is None:
        return source
    from sim.smoke.source_motion import placed_on

    return placed_on(source, body)


def mesh_shapes(job: Job) -> Iterator[tuple[KeyPath, MeshShape]]:
    """Every mesh of the job, with the path of its shape's table."""
    for place, placement in placements(job):
        if isinstance(placement.shape, MeshShape):
            yield (*place, "shape"), placement.shape
    for index, cloth in enumerate(job.cloth):
        if isinstance(cloth.shape, MeshShape):
            yield ("cloth", index, "shape"), cloth.shape
