"""Presets: the same job in another size, expressed as overrides so that the saved copy says everything."""

from __future__ import annotations

from pipeline.job.models import Job
from pipeline.job.overrides import Override

PREVIEW = "--preview"
COARSENING = 2.0
"""Particle radii and cells grow by this factor: an eighth of the particles and cells, and larger steps."""


def preview_overrides(job: Job) -> list[Override]:
    """A fast, small version: half the picture, coarse physics, draft quality; the same scene, camera and length."""
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
    for index, smoke in enumerate(job.smoke):
        changes.append((("smoke", index, "cell_size"), smoke.cell_size * COARSENING))
    return [Override(path, value, PREVIEW) for path, value in changes]


def _half(pixels: int) -> int:
    """Half as many, rounded to an even number as video needs it, 16 at least as the schema asks."""
    return max(16, 2 * round(pixels / 4))
