"""What made the files of a job: versions of the program, of its tools and of its stages, as receipts tell them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.layout import JobLayout
from pipeline.manifest_reader import ArtifactRow
from pipeline.origins import origins_of
from pipeline.receipts import read_receipt
from pipeline.task import ArtifactPath


@dataclass(frozen=True, slots=True)
class MadeWith:
    """What made some files of a stage.

    Attributes:
        stage: the stage.
        tools: versions of the stage and of the tools that did the work; empty if the parameters were not kept.
        maker: program, Python and kind of machine; empty in older receipts.
        host: name of the machine.
        files: how many were made with the same parameters.
    """

    stage: str
    tools: Mapping[str, str]
    maker: str
    host: str
    files: int


def made_with(layout: JobLayout, artifacts: Mapping[ArtifactPath, ArtifactRow]) -> list[MadeWith]:
    """By stage and parameters; of each the receipt of one file is read.

    Args:
        layout: the job's folder.
        artifacts: every artifact on record.
    """
    groups: dict[str, list[ArtifactPath]] = {}
    for path, row in artifacts.items():
        groups.setdefault(row.parameters, []).append(path)
    found = []
    for paths in groups.values():
        receipt = read_receipt(layout, paths[-1])
        if receipt is not None:
            (origin,) = origins_of(layout, [receipt])
            found.append(MadeWith(receipt.stage, origin.tools or {}, receipt.maker, receipt.host, len(paths)))
    return found
