"""Files that jobs share: what another job of the same study has made from the same, a job takes over and does not make.

A study's jobs lie beside each other, and each names the others in `siblings.json`. At the start of a run every task is
held against their receipts: where one was committed with the fingerprint that the task has here, its files are linked
into the job's folder (hard links; copies where the file system has none), each with a receipt of its own. So each
folder is whole by itself: files of one may be removed, moved or made anew, and the others keep theirs.
"""

import json
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from pipeline.base.errors import StaleAttemptError
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import digest_of
from pipeline.base.task import ArtifactPath, Task, task_fingerprint
from pipeline.base.wording import counted
from pipeline.model.job import NAME_PATTERN
from pipeline.run.plan import Assessment
from pipeline.store.artifacts import take_over
from pipeline.store.receipts import Receipt, committed_receipt

_NAME = re.compile(NAME_PATTERN)


class Shared(NamedTuple):
    """What a job has taken over."""

    files: int = 0
    owners: tuple[str, ...] = ()  # names of the jobs that they come from

    def __str__(self) -> str:
        """`60 files are taken over from drop-a, made from the same`."""
        verb = "is" if self.files == 1 else "are"
        return f"{counted(self.files, 'file')} {verb} taken over from {', '.join(self.owners)}, made from the same"


def write_siblings(layout: JobLayout, names: Collection[str]) -> None:
    """Name the other jobs of a study, which lie beside it, with those that are named already and there."""
    known = (sibling.root.name for sibling in read_siblings(layout))
    replace_durably(layout.siblings, json.dumps({"jobs": sorted({*names, *known})}) + "\n")


def read_siblings(layout: JobLayout) -> list[JobLayout]:
    """The other jobs of its study that are there; none of a file that is none."""
    try:
        names = json.loads(layout.siblings.read_text(encoding="utf-8"))["jobs"]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return []
    own = layout.root.absolute()
    named = [str(name) for name in names if _NAME.fullmatch(str(name))] if isinstance(names, list) else []
    return [JobLayout(own.parent / name) for name in named if name != own.name and (own.parent / name).is_dir()]


def take_over_shared(layout: JobLayout, tasks: Sequence[Task]) -> Shared:
    """Take over what siblings have made of these tasks, makers before users. The caller holds the job's lease."""
    siblings = read_siblings(layout)
    if not siblings:
        return Shared()
    hashes: dict[ArtifactPath, str] = {}
    files, owners = 0, dict[str, None]()
    for task in tasks:
        if any(path not in hashes for path in task.inputs):
            continue  # something that it is made from is to be made here, and nothing can be told before
        fingerprint = task_fingerprint(task, hashes)
        receipts = _all_of(layout, task, fingerprint)
        if receipts is None:
            found = ((each, _all_of(each, task, fingerprint)) for each in siblings)
            sibling, receipts = next(((each, theirs) for each, theirs in found if theirs is not None), (None, None))
            if sibling is None or receipts is None:
                continue
            try:
                for receipt in receipts:
                    take_over(layout, receipt, sibling)
            except (FileNotFoundError, StaleAttemptError):
                continue  # the other job has removed it or made it anew meanwhile, or this one newer: it is made here
            files += len(receipts)
            owners[sibling.root.name] = None
        hashes.update({receipt.artifact: receipt.hash for receipt in receipts})
    return Shared(files, tuple(owners))


def _all_of(layout: JobLayout, task: Task, fingerprint: str) -> list[Receipt] | None:
    """Receipts of all outputs of a task, made from this fingerprint; None if one is not there."""
    receipts = []
    for output in task.outputs:
        receipt = committed_receipt(layout, output, fingerprint)
        if receipt is None or layout.path(output).is_symlink():
            return None
        receipts.append(receipt)
    return receipts


def made_once(assessments: Sequence[Assessment], seen: set[str]) -> tuple[list[Assessment], int]:
    """The assessments of what is to be made and is not made by a job before, and how many files such a job gives.

    `seen` holds what those before make, each task by all that decides it; what these make is added.
    """
    digests: dict[ArtifactPath, str] = {}
    own, shared = [], 0
    for each in assessments:
        made_of = [digests[path] for path in each.task.inputs]
        digest = digest_of("\n".join([each.task.id, each.task.parameters.digest, *made_of]))
        digests.update(dict.fromkeys(each.task.outputs, digest))
        if each.rebuilds and digest in seen:
            shared += len(each.rebuilds)
        else:
            own.append(each)
            seen.add(digest)
    return own, shared
