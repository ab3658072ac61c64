"""Disk space: how much a job will take, and how much of it stays free."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.base import wording
from pipeline.kinds.table import KINDS
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.whitewater.kinds import drops_of_particle

RESERVE_BYTES = 2 * 2**30
"""Free space at which a job pauses: a checkpoint of a large simulation and a few frames fit."""
RESERVE_SHARE = 0.05
"""The reserve of a small disk is this share of it."""


def free_bytes(folder: Path) -> int:
    """Free space on the disk that a folder lies on [bytes]."""
    return shutil.disk_usage(folder).free


def usual_reserve_bytes(folder: Path) -> int:
    """The reserve where nobody has asked for another one [bytes]."""
    return min(RESERVE_BYTES, int(shutil.disk_usage(folder).total * RESERVE_SHARE))


def shortage(folder: Path, reserve_bytes: int | None) -> str | None:
    """A sentence if less than the reserve is free on the disk of a folder, else None; the usual reserve for None."""
    free = free_bytes(folder)
    reserve = usual_reserve_bytes(folder) if reserve_bytes is None else reserve_bytes
    if free >= reserve:
        return None
    return f"only {wording.size(free)} are free on the disk, less than the reserve of {wording.size(reserve)}"


class Size(NamedTuple):
    """What decides how much a frame of a job takes."""

    elements: Mapping[str, float]  # particles, cells or nodes of all bodies of a kind, by its name
    pixels: int  # of a picture
    picture_bytes_per_pixel: float = 1.2  # what a picture takes, on the mean of its files [bytes]
    film_factor: float = 1.0  # how much more a film takes than one of H.264 [-]
    drops_per_particle: float = 0.0  # of spray, on average [-]
    bodies: Mapping[str, Sequence[Any]] = {}  # those of a kind that have files of their own; one if not said

    def mean(self, kind: str) -> float:
        """Elements of a body of a kind, on average; 0 of none."""
        return self.elements.get(kind, 0.0) / max(1, len(self.bodies.get(kind, ())))


def size_of(job: Job, findings: Findings) -> Size:
    """The size of a job that was checked."""
    width, height = job.render.resolution
    return Size(
        findings.elements,
        width * height,
        _picture_bytes_per_pixel(job),
        _PRORES_FACTOR if job.movie.codec == "prores" else 1.0,
        _drops_per_particle(job),
        {
            name: [body for body in kind.bodies(job) if kind.product.of(body)]
            for name, kind in KINDS.items()
            if kind.product is not None
        },
    )


def _drops_per_particle(job: Job) -> float:
    """Of the largest particles, once they have broken up."""
    largest = max((fluid.particle_radius for fluid in job.fluid), default=0.0)
    diameter, most = job.surface.drop_diameter, job.surface.drops_per_particle
    return drops_of_particle(particle_radius=largest, diameter=diameter, most=most)


def _picture_bytes_per_pixel(job: Job) -> float:
    """Measured with a draft of the quickstart at 480x270; a job with masters has two files a frame."""
    png = 4.7 if job.render.format == "png16" else 1.2
    if not job.render.has_master:
        return png
    passes = len(job.render.passes)
    return (png + (5.0 + 6.0 * passes if passes else 1.0)) / 2


_PRORES_FACTOR = 30.0

_SPRAY_SHARE = 0.03
"""Of a fluid's particles, on the mean of a film that splashes [-]: 1 to 3.4 % measured, 4 to 10 % at its wildest."""
_DROP_BYTES = 33.0

_BYTES_PER_ARTIFACT: Mapping[str, Callable[[Size], float]] = {
    "simulate": lambda size: 22_000 + _snapshot_bytes(size, 1),
    # Two files a frame: kinds of particles, and drops.
    "spray": lambda size: 0.5 * size.mean("fluid") * (1.0 + _SPRAY_SHARE * _DROP_BYTES * size.drops_per_particle),
    "whitewater": lambda size: 10.0 * size.mean("fluid"),
    "bodies": lambda _: 400_000.0,
    "bounds": lambda _: 3000.0,
    "render": lambda size: 1_000 + size.picture_bytes_per_pixel * size.pixels,
    # Segments of 120 frames and the film; a frame takes a tenth of a byte a pixel in each.
    "movie": lambda size: 12.0 * size.film_factor * size.pixels,
}
"""What one file of a stage takes, roughly, where nothing has been made yet to go by [bytes]."""


def _snapshot_bytes(size: Size, where: int) -> float:
    """Of the bodies of all kinds; `where` as in `Kind.snapshot_bytes`."""
    return sum(kind.snapshot_bytes[where] * size.elements.get(name, 0.0) for name, kind in KINDS.items())


def bytes_per_artifact(stage: str, size: Size) -> float:
    """What one file of a stage takes, about [bytes]; those of a product of bodies by their kind."""
    for name, kind in KINDS.items():
        if kind.product is not None and kind.product.stage == stage:
            bodies = size.bodies.get(name, ())
            return sum(kind.product.file_bytes(body, size.mean(name)) for body in bodies) / max(1, len(bodies))
    return _BYTES_PER_ARTIFACT[stage](size) if stage in _BYTES_PER_ARTIFACT else 0.0


def checkpoint_bytes(size: Size) -> float:
    """What checkpoints of a simulation take, of which two are kept [bytes]."""
    return 2 * _snapshot_bytes(size, 2)
