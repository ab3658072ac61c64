"""The stages of a job, each with a pure plan() and an idempotent run()."""

from __future__ import annotations

from pipeline.stages.base import Stage
from pipeline.stages.bodies import BodiesStage
from pipeline.stages.bounds import BoundsStage
from pipeline.stages.cloth import ClothStage
from pipeline.stages.movie import MovieStage
from pipeline.stages.render import RenderStage
from pipeline.stages.simulate import SimulateStage
from pipeline.stages.surface import SurfaceStage
from pipeline.stages.volume import VolumeStage
from pipeline.stages.whitewater import WhitewaterStage

STAGES: tuple[Stage, ...] = (
    BodiesStage(),
    SimulateStage(),
    SurfaceStage(),
    ClothStage(),
    VolumeStage(),
    WhitewaterStage(),
    BoundsStage(),
    RenderStage(),
    MovieStage(),
)
"""Every stage, in the order of the pipeline."""
