"""Committing artifacts: write aside, decode, hash, fsync, rename, receipt.

An artifact counts only with its *receipt*; see pipeline.store.receipts.

    write .<name>.part.<attempt>  ->  validate (decode it)  ->  hash  ->  fsync  ->  receipt aside, fsync
    -> [locked: fence -> keep an edited file aside -> remove the old receipt, fsync its folder
                -> rename the file, fsync its folder -> rename the receipt, fsync its folder]

No crash point leaves a receipt that matches a wrong file:

* Before the old receipt is removed, the old file and its receipt stand untouched; only part files are left over. All
  that takes disk space happens here, so a full disk costs nothing that was there.
* The removal of the old receipt is durable before the file is renamed. From here until the new receipt stands there
  is a file without receipt, be it the old or the new one: it does not count, the task runs again and overwrites it.
  That holds for a power cut as well, whatever order the file system chooses for what was not synced.
* The new receipt appears by a rename, so it is there as a whole or not at all, and only after the artifact's bytes and
  name have been synced: it never describes something that a power cut took away.
* An edited file that stood in the way is renamed before its receipt is removed: a crash in between leaves a receipt
  without file, which does not count either.

The locked section makes "look at the existing receipt, then replace it" one step for all processes: a late writer of
an older attempt finds the newer receipt and gives up. The lock is a `flock` on a file of the receipts' folder; the
kernel drops it with its holder, so none is ever left behind.
"""

import errno
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import InvalidArtifactError, StaleAttemptError
from pipeline.base.files import locked, make_folder, replace_durably, sync
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task
from pipeline.store.provenance import keep_texts, maker
from pipeline.store.receipts import Receipt, hash_file, read_receipt, verify_artifact

_PART_NAME = re.compile(r"^\..+\.part\.\d+(-journal)?$")
_LOCK_NAME = ".lock"
_NO_HARD_LINKS = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Two file systems, one without hard links, or too many names of a file."""


def edited_name(layout: JobLayout, artifact: ArtifactPath) -> ArtifactPath:
    """Name under which a file that was edited by hand is kept when its artifact is made anew: `<name>.edited-<n>`."""
    number = 1
    while os.path.lexists(layout.path(ArtifactPath(f"{artifact}.edited-{number}"))):
        number += 1
    return ArtifactPath(f"{artifact}.edited-{number}")


def holds_frames(layout: JobLayout) -> bool:
    """Whether anything lies where a job's simulated frames and its pictures go. Raises OSError."""
    for frame in (layout.frame_cache(0), layout.picture(0)):
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(layout.path(frame).parent) as entries:
            if any(entries):
                return True
    return False


@dataclass
class Commit:
    """An artifact on its way; see `committing`."""

    path: Path  # where to write it: `.<name>.part.<attempt>`, in the artifact's own folder
    kept_aside: ArtifactPath | None = None  # where a file that was edited by hand went, if there was one in the way
    done: Receipt | None = None

    @property
    def receipt(self) -> Receipt:
        """The receipt; there is one after the block has ended well."""
        if self.done is None:
            raise RuntimeError(f"{self.path} is not committed yet")
        return self.done


@contextmanager
def committing(
    layout: JobLayout,
    artifact: ArtifactPath,
    *,
    task: Task,
    attempt: int,
    fingerprint: str,
    validate: Callable[[Path], None],
    inputs: Mapping[ArtifactPath, str] | None = None,
    device: str = "",
) -> Iterator[Commit]:
    """Commit one artifact: write to `commit.path` inside the block; after it `commit.receipt` is the Receipt.

    On leaving the block: validate, hash, fsync, fence, rename, receipt; the module's text gives the order and why. An
    exception in the block or on the way removes the part file and passes through untouched, so ENOSPC stays the
    OSError that it is.

    Args:
        fingerprint: `task_fingerprint` of the task with the inputs as they are now.
        validate: decodes the file; raises InvalidArtifactError if it is not what it should be.
        inputs: hash of each input, kept so that `explain` can name the one that changed.
        device: what computes it, if that decides its last bits.

    Raises:
        FolderGoneError: the job's folder is not there any more.
        InvalidArtifactError: on leaving, if nothing was written or `validate` refused it.
        StaleAttemptError: on leaving, if a newer attempt of the same task has committed this artifact.
    """
    target, receipt_path = layout.path(artifact), layout.receipt(artifact)
    commit, receipt_part = Commit(_part_path(target, attempt)), _part_path(receipt_path, attempt)
    started = _now_s()
    make_folder(target.parent, within=layout.root)
    commit.path.unlink(missing_ok=True)
    try:
        yield commit
        if not commit.path.is_file():
            raise InvalidArtifactError(f"{artifact}: nothing was written, or a newer run has swept it away")
        validate(commit.path)
        job = keep_texts(layout, task.parameters)
        content_hash = hash_file(commit.path)
        sync(commit.path)
        status = commit.path.stat()  # only now are its size and time settled
        receipt = Receipt(
            artifact=artifact,
            task=task.id,
            stage=task.stage,
            attempt=attempt,
            fingerprint=fingerprint,
            parameters=task.parameters.digest,
            size=status.st_size,
            mtime_ns=status.st_mtime_ns,
            hash=content_hash,
            inputs=dict(inputs or {}),
            job=job,
            maker=maker(),
            host=platform.node(),
            device=device,
            started=started,
            finished=_now_s(),
        )
        make_folder(receipt_path.parent, within=layout.root)
        receipt_part.write_text(receipt.to_json())
        sync(receipt_part)
        with locked(receipt_path.with_name(_LOCK_NAME)):
            _fence(layout, receipt)
            commit.kept_aside = _invalidate(layout, artifact)
            commit.path.replace(target)
            sync(target.parent)
            receipt_part.replace(receipt_path)
            sync(receipt_path.parent)
        commit.done = receipt
    finally:
        for part in (commit.path, receipt_part):
            with suppress(OSError):  # must not hide the error that is on its way; sweep_parts gets what stays
                part.unlink(missing_ok=True)


def take_over(layout: JobLayout, receipt: Receipt, owner: JobLayout) -> None:
    """Commit an artifact that another job has made: the same file under a second name, and its receipt beside it.

    A copy, where the file system has no hard links, or the folders lie on two. The texts that the receipt names come
    along. In the order of `committing`, and as safe. Nobody writes into an artifact: what is made anew takes its name,
    and leaves the other job's alone.
    """
    target, receipt_path = layout.path(receipt.artifact), layout.receipt(receipt.artifact)
    for text, kept in (
        (owner.job_text(receipt.job), layout.job_text(receipt.job)),
        (owner.parameters_text(receipt.parameters), layout.parameters_text(receipt.parameters)),
    ):
        if text.is_file() and not kept.exists():
            make_folder(kept.parent, within=layout.root)
            replace_durably(kept, text.read_bytes())
    make_folder(target.parent, within=layout.root)
    make_folder(receipt_path.parent, within=layout.root)
    part = _part_path(target, receipt.attempt)
    part.unlink(missing_ok=True)
    source = owner.path(receipt.artifact)
    try:
        os.link(source, part)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        shutil.copy2(source, part)
        sync(part)
    try:
        if (status := part.stat()).st_size != receipt.size or status.st_mtime_ns != receipt.mtime_ns:
            raise FileNotFoundError(errno.ENOENT, "was made anew while it was taken over", str(source))
        with locked(receipt_path.with_name(_LOCK_NAME)):
            _fence(layout, receipt)
            _invalidate(layout, receipt.artifact)
            part.replace(target)
            sync(target.parent)
            replace_durably(receipt_path, receipt.to_json())
    finally:
        part.unlink(missing_ok=True)  # a second name of the same file is not renamed onto the first


def sweep_parts(layout: JobLayout) -> list[Path]:
    """Remove the part files that dead attempts left anywhere in the job's folder; returns what was removed.

    Only the holder of the job's lease may call it, before it starts an attempt of its own. A writer that is alive all
    the same (an orphan on another machine) then fails at its commit, without harm.
    """
    swept = []
    for folder, _, names in os.walk(layout.root):
        for name in names:
            if _PART_NAME.match(name):
                path = Path(folder, name)
                path.unlink(missing_ok=True)
                swept.append(path)
    return sorted(swept)


def remove_parts_of(layout: JobLayout, attempts: Iterable[tuple[ArtifactPath, int]]) -> None:
    """Remove what dead attempts left of their outputs, each given with the attempt's number, which no other has.

    For a run whose job was taken over: its last write may have hung until after the other run had swept.
    """
    for artifact, attempt in attempts:
        for path in (layout.path(artifact), layout.receipt(artifact)):
            with suppress(OSError):  # the folder may be gone; the job is another run's, which goes on without
                _part_path(path, attempt).unlink(missing_ok=True)


def _fence(layout: JobLayout, receipt: Receipt) -> None:
    """Raise StaleAttemptError if a newer attempt of the task has committed the artifact."""
    existing = read_receipt(layout, receipt.artifact)
    if existing is not None and existing.task == receipt.task and existing.attempt > receipt.attempt:
        raise StaleAttemptError(
            f"{receipt.artifact}: attempt {existing.attempt} of {receipt.task} has committed it; "
            f"attempt {receipt.attempt} came too late"
        )


def _now_s() -> float:
    """Wall time [s since the epoch], of as many digits that none of them can change without changing the number."""
    return round(time.time(), 6)


def _part_path(path: Path, attempt: int) -> Path:
    return path.with_name(f".{path.name}.part.{attempt}")


def _invalidate(layout: JobLayout, artifact: ArtifactPath) -> ArtifactPath | None:
    """Remove the old receipt, durably; first keep aside what somebody changed by hand since it was written."""
    receipt = read_receipt(layout, artifact)
    kept_aside = None
    if receipt is not None and verify_artifact(layout, receipt) is not None:
        target = layout.path(artifact)
        if target.is_file() and target.stat().st_size > 0:  # an empty file holds nothing to keep
            kept_aside = edited_name(layout, artifact)
            target.rename(layout.path(kept_aside))
    receipt_path = layout.receipt(artifact)
    if receipt_path.exists():
        receipt_path.unlink()
        sync(receipt_path.parent)
    return kept_aside
