"""The stages of a job, each with a pure plan() and an idempotent run()."""

from collections.abc import Sequence
from typing import Any

from pipeline.kinds.table import KINDS
from pipeline.stages.base import Stage
from pipeline.stages.bodies import BodiesStage
from pipeline.stages.bounds import BoundsStage
from pipeline.stages.export import ExportStage
from pipeline.stages.export_blend import AbcExport, BlendExport
from pipeline.stages.export_gltf import GltfExport
from pipeline.stages.export_usd import UsdExport
from pipeline.stages.export_vtk import VtkExport
from pipeline.stages.movie import MovieStage
from pipeline.stages.product import ProductStage
from pipeline.stages.render import RenderStage
from pipeline.stages.simulate import SimulateStage
from pipeline.stages.spray import SprayStage
from pipeline.stages.whitewater import WhitewaterStage

EXPORTS: dict[str, ExportStage] = {
    stage.format: stage for stage in (UsdExport(), BlendExport(), AbcExport(), VtkExport(), GltfExport())
}
"""What a job can be exported to, by the name of the format."""


class _Stages(Sequence[Stage]):
    """The stages, those of the products of all kinds of bodies among them: the table of kinds may grow."""

    def _all(self) -> tuple[Stage, ...]:
        before: tuple[Stage, ...] = (BodiesStage(), SimulateStage(), SprayStage())
        products = (ProductStage(kind, kind.product) for kind in KINDS.values() if kind.product is not None)
        return (*before, *products, WhitewaterStage(), BoundsStage(), *EXPORTS.values(), RenderStage(), MovieStage())

    def __len__(self) -> int:
        return len(self._all())

    def __getitem__(self, index: Any) -> Any:
        return self._all()[index]


STAGES: Sequence[Stage] = _Stages()  # every stage, in the order of the pipeline
