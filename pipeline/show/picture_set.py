"""The frames of a job that belong together, by their receipts: what a film can be made of, whoever drew them.

Neither the record nor the caches need to be there, nor does the job have to be as it was: frames that were drawn by
another version of a program, with what were the defaults then, make a film as well as those of today.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, TaskId
from pipeline.model.job import Job
from pipeline.run.plan import plan_job
from pipeline.store.receipts import Receipt, read_receipt, verify_artifact


@dataclass(frozen=True)
class PictureSet:
    """Frames that were made alike."""

    by_frame: Mapping[int, Path]  # by their numbers, rising
    earlier: int = 0  # how many others are there, drawn before by other settings
    remark: str = ""  # on a set that is not of the job as it would be made now; empty if nothing is known to differ

    @property
    def all(self) -> list[Path]:
        """First to last."""
        return [*self.by_frame.values()]

    @property
    def unbroken(self) -> list[Path]:
        """Those from the first frame on, up to the first one that is not there."""
        return [picture for number, (frame, picture) in enumerate(self.by_frame.items()) if number == frame]

    @property
    def others(self) -> str:
        """What to say of frames that are there and do not count; empty if there are none."""
        return f" ({self.earlier} more are of an earlier version of it)" if self.earlier else ""


def picture_set(job: Job, layout: JobLayout) -> PictureSet:
    """The frames that were made as the one was that was drawn last."""
    there: dict[int, Receipt] = {}
    for frame in range(job.frame_count):
        receipt = read_receipt(layout, layout.picture(frame))
        if receipt is not None and verify_artifact(layout, receipt) is None:
            there[frame] = receipt
    if not there:
        return PictureSet({})
    lineages = _Lineages(layout)
    newest = lineages.of(max(there.values(), key=lambda each: each.finished or each.mtime_ns / 1e9))
    alike = {frame: receipt for frame, receipt in there.items() if _made_alike(lineages.of(receipt), newest)}
    return PictureSet(
        {frame: layout.path(receipt.artifact) for frame, receipt in alike.items()},
        earlier=len(there) - len(alike),
        remark=_remark(job, layout, map(lineages.of, alike.values())),
    )


def evenly_spread(frames: Sequence[Path], count: int) -> list[Path]:
    """At most `count` of the frames, the first and the last among them."""
    if len(frames) <= count:
        return [*frames]
    if count == 1:
        return [frames[-1]]
    return [frames[round(index * (len(frames) - 1) / (count - 1))] for index in range(count)]


class _Lineage(NamedTuple):
    """How something was made, as far as receipts tell: digests of parameters by what stages are about."""

    made: Mapping[str, frozenset[str]]  # of itself and of what it was made from
    changed: Mapping[str, frozenset[str]]  # of what has taken the place of inputs since


class _Lineages:
    """Walks from artifacts to what they were made from, and remembers what it has seen."""

    def __init__(self, layout: JobLayout) -> None:
        self._layout = layout
        self._receipts: dict[ArtifactPath, Receipt | None] = {}
        self._known: dict[ArtifactPath, _Lineage] = {}

    def of(self, receipt: Receipt) -> _Lineage:
        """The lineage of an artifact; inputs whose receipt is gone, as after `clean`, tell nothing."""
        if receipt.artifact in self._known:
            return self._known[receipt.artifact]
        made, changed = {_subject(receipt.task): frozenset({receipt.parameters})}, dict[str, frozenset[str]]()
        for artifact, content in receipt.inputs.items():
            if artifact not in self._receipts:
                self._receipts[artifact] = read_receipt(self._layout, artifact)
            source = self._receipts[artifact]
            if source is None:
                continue
            if source.hash != content:
                _add(changed, {_subject(source.task): frozenset({source.parameters})})
                continue
            lineage = self.of(source)
            _add(made, lineage.made)
            _add(changed, lineage.changed)
        return self._known.setdefault(receipt.artifact, _Lineage(made, changed))


def _add(to: dict[str, frozenset[str]], more: Mapping[str, frozenset[str]]) -> None:
    for subject, digests in more.items():
        to[subject] = to.get(subject, frozenset()) | digests


def _subject(task: TaskId) -> str:
    """What a task is about besides its frame: its stage, and the body."""
    return re.sub(r"/\d+$", "", task)


def _made_alike(one: _Lineage, newest: _Lineage) -> bool:
    """Whether nothing is known in which a picture differs from the one that was drawn last. Pure."""
    alike = all(newest.made.get(subject, digests) == digests for subject, digests in one.made.items())
    # It was drawn before its inputs were made as those of the newest one are.
    behind = any(newest.made.get(subject, frozenset()) & digests for subject, digests in one.changed.items())
    return alike and not behind


def _remark(job: Job, layout: JobLayout, lineages: Iterable[_Lineage]) -> str:
    from pipeline.stages import STAGES

    try:
        planned = {_subject(task.id): frozenset({task.parameters.digest}) for task in plan_job(job, layout, STAGES)}
    except PipelineError as error:
        return f"whether its frames are as the job would be made now cannot be told: {error}"
    changed = set[str]()
    for lineage in lineages:
        changed.update(subject for subject, digests in lineage.made.items() if planned.get(subject) != digests)
        changed.update(lineage.changed)
    differs = ", ".join(sorted(changed))
    return f"its frames are not as the job would be made now; what differs: {differs}" if differs else ""
