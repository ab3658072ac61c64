"""Presets: the same job in another size, expressed as overrides so that the saved copy says everything."""

from functools import partial

from pipeline.job.magnitudes import check_magnitudes
from pipeline.job.overrides import Override
from pipeline.kinds.checks.shapes import build_solids
from pipeline.kinds.table import KINDS, placements
from pipeline.model.job import Job
from pipeline.model.problems import Findings

PREVIEW = "--preview"
COARSENING = 2.0
"""Particle radii, cells and the cells of cloths grow by this factor: an eighth of the particles and cells, a quarter of
the nodes, and larger steps. Cells of smoke grow less where a source or a body would be lost between them; gusts grow
where coarser cells could not carry their eddies."""


def preview_overrides(job: Job) -> list[Override]:
    """A fast, small version: half the picture, coarse physics, draft quality; the same scene, camera and length.

    The job has absolute mesh paths.
    """
    width, height = job.render.resolution
    changes: list[tuple[tuple[str | int, ...], object]] = [
        (("name",), f"{job.name[:92]}-preview"),
        (("render", "resolution"), [_half(width), _half(height)]),
        (("render", "quality"), "draft"),
    ]
    if job.render.samples is not None:
        changes.append((("render", "samples"), max(1, job.render.samples // 4)))
    # What is wrong with numbers and shapes is told of the changed job.
    can_be_built = check_magnitudes(job, Findings())
    solids = partial(build_solids, placements(job), Findings()) if can_be_built else None
    changes += [change for kind in KINDS.values() for change in kind.coarser(job, COARSENING, solids)]
    return [Override(path, value, PREVIEW) for path, value in changes]


def _half(pixels: int) -> int:
    """Half as many, rounded to an even number as video needs it, 16 at least as the schema asks."""
    return max(16, 2 * round(pixels / 4))
