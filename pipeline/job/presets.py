"""Presets: the same job in another size, expressed as overrides so that the saved copy says everything."""

from __future__ import annotations

from pipeline.job.coarser_smoke import coarser_cell_sizes
from pipeline.job.models import Job
from pipeline.job.overrides import Override
from sim.cloth.parameters import RectangleSheet
from sim.smoke.parameters import CELLS_PER_EDDY

PREVIEW = "--preview"
COARSENING = 2.0
"""Particle radii, cells and the cells of cloths grow by this factor: an eighth of the particles and cells, a quarter of
the nodes, and larger steps. Cells of smoke grow less where a source or a body would be lost between them; gusts grow
where coarser cells could not carry their eddies."""


def preview_overrides(job: Job) -> list[Override]:
    """A fast, small version: half the picture, coarse physics, draft quality; the same scene, camera and length.

    Args:
        job: with absolute mesh paths.
    """
    width, height = job.render.resolution
    changes: list[tuple[tuple[str | int, ...], object]] = [
        (("name",), f"{job.name[:92]}-preview"),
        (("render", "resolution"), [_half(width), _half(height)]),
        (("render", "quality"), "draft"),
    ]
    if job.render.samples is not None:
        changes.append((("render", "samples"), max(1, job.render.samples // 4)))
    for index, fluid in enumerate(job.fluid):
        changes.append((("fluid", index, "particle_radius"), fluid.particle_radius * COARSENING))
        if fluid.dt != "adaptive":
            changes.append((("fluid", index, "dt"), fluid.dt * COARSENING))
    cell_sizes = coarser_cell_sizes(job, COARSENING)
    for index, (smoke, cell_size) in enumerate(zip(job.smoke, cell_sizes, strict=True)):
        changes.append((("smoke", index, "cell_size"), cell_size))
        gusts = smoke.turbulence
        if gusts.strength > 0.0 and gusts.size < CELLS_PER_EDDY * cell_size:
            changes.append((("smoke", index, "turbulence", "size"), CELLS_PER_EDDY * cell_size))
    for index, cloth in enumerate(job.cloth):
        # Pins would hold others in a coarser sheet where they name nodes by number, and others or none in a region.
        by_place = all(pin.index is None and pin.region is None for pin in cloth.pin)
        if isinstance(cloth.shape, RectangleSheet) and by_place:
            changes.append(_coarser(("cloth", index, "shape"), cloth.shape))
    return [Override(path, value, PREVIEW) for path, value in changes]


def _coarser(path: tuple[str | int, ...], sheet: RectangleSheet) -> tuple[tuple[str | int, ...], object]:
    """The key that divides a sheet, and its value for half as many cells along each side."""
    if sheet.counts is None:
        assert sheet.resolution is not None
        return (*path, "resolution"), sheet.resolution * COARSENING
    return (*path, "counts"), [max(2, round((count - 1) / COARSENING) + 1) for count in sheet.counts]


def _half(pixels: int) -> int:
    """Half as many, rounded to an even number as video needs it, 16 at least as the schema asks."""
    return max(16, 2 * round(pixels / 4))
