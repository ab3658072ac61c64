"""What made the files of a job: versions of the program, of its tools and of its stages, as receipts tell them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.store.origins import origins_of
from pipeline.store.receipts import read_receipt


@dataclass(frozen=True, slots=True)
class MadeWith:
    """What made some files of a stage.

    Attributes:
        stage: the stage.
        tools: versions of the stage and of the tools that did the work; empty if the parameters were not kept.
        maker: program, Python and kind of machine; empty in older receipts.
        host: name of the machine.
        files: how many.
    """

    stage: str
    tools: Mapping[str, str]
    maker: str
    host: str
    files: int


def made_with(layout: JobLayout, artifacts: Iterable[ArtifactPath], *, stages: Sequence[str]) -> list[MadeWith]:
    """What made which files, as the receipt of each tells: files of one version may come from several machines.

    Args:
        layout: the job's folder.
        artifacts: every artifact on record.
        stages: in the order in which they are told; others come last.
    """
    tools: dict[str, tuple[tuple[str, str], ...]] = {}
    files: Counter[tuple[str, tuple[tuple[str, str], ...], str, str]] = Counter()
    for path in artifacts:
        receipt = read_receipt(layout, path)
        if receipt is None:
            continue
        if receipt.parameters not in tools:
            (origin,) = origins_of(layout, [receipt])
            tools[receipt.parameters] = tuple((origin.tools or {}).items())
        files[receipt.stage, tools[receipt.parameters], receipt.maker, receipt.host] += 1
    found = [MadeWith(stage, dict(tools), maker, host, count) for (stage, tools, maker, host), count in files.items()]
    place = {stage: index for index, stage in enumerate(stages)}
    return sorted(found, key=lambda each: place.get(each.stage, len(place)))
