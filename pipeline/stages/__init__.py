"""The stages of a job, each with a pure plan() and an idempotent run()."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import overload

from pipeline.kinds.table import KINDS
from pipeline.stages.base import Stage
from pipeline.stages.bodies import BodiesStage
from pipeline.stages.bounds import BoundsStage
from pipeline.stages.movie import MovieStage
from pipeline.stages.product import product_stages
from pipeline.stages.render import RenderStage
from pipeline.stages.simulate import SimulateStage
from pipeline.stages.whitewater import WhitewaterStage


class _Stages(Sequence[Stage]):
    """The stages, those of the products of all kinds of bodies among them."""

    def _all(self) -> tuple[Stage, ...]:
        before: tuple[Stage, ...] = (BodiesStage(), SimulateStage())
        after: tuple[Stage, ...] = (WhitewaterStage(), BoundsStage(), RenderStage(), MovieStage())
        return (*before, *product_stages(KINDS), *after)

    def __iter__(self) -> Iterator[Stage]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    @overload
    def __getitem__(self, index: int) -> Stage: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Stage, ...]: ...
    def __getitem__(self, index: int | slice) -> Stage | tuple[Stage, ...]:
        return self._all()[index]


STAGES: Sequence[Stage] = _Stages()
"""Every stage, in the order of the pipeline."""
