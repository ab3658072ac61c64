"""Bring the record and the files together at the start of a run, whatever ended the last one."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from operator import attrgetter
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import digest_of
from pipeline.base.places import check_places
from pipeline.base.task import ArtifactPath, FailureKind, TaskState
from pipeline.base.wording import counted
from pipeline.record.manifest import Manifest, artifact_row
from pipeline.record.reader import ArtifactRow, ManifestReader
from pipeline.store.artifacts import edited_name, sweep_parts
from pipeline.store.receipts import Receipt, hash_file, read_receipt, verify_artifact


class FileCondition(StrEnum):
    """Condition of a recorded artifact's file that does not count."""

    MISSING = "missing"
    EDITED = "edited"
    INTERRUPTED = "interrupted"  # its commit was cut short: the file may be the old or the new one, and has no receipt


@dataclass(frozen=True, slots=True)
class FileProblem:
    """Fault of a recorded artifact's file."""

    condition: FileCondition
    reason: str  # a sentence about this file


@dataclass(frozen=True, slots=True)
class Inspection:
    """State of the recorded artifacts' files."""

    problems: dict[ArtifactPath, FileProblem]  # of artifacts whose file does not count
    new_mtimes_ns: dict[ArtifactPath, int]  # of files that were touched or copied, but hold the recorded bytes
    newer_receipts: tuple[Receipt, ...]  # of files committed again that the record does not know


@dataclass(frozen=True, slots=True)
class Reconciliation:
    """The record as it stands now, and what was put right."""

    rows: dict[ArtifactPath, ArtifactRow]  # every artifact on record, those with a problem included
    problems: dict[ArtifactPath, FileProblem]  # of artifacts whose file does not count
    sentences: tuple[str, ...]  # for the user, one line each; none after a clean run that nobody has touched

    @property
    def valid_rows(self) -> dict[ArtifactPath, ArtifactRow]:
        """The artifacts that count; input of `plan.up_to_date`."""
        return {path: row for path, row in self.rows.items() if path not in self.problems}


def reconcile(manifest: Manifest, layout: JobLayout, *, clean: bool) -> Reconciliation:
    """Bring the record and the files together.

    Always: attempts that are still open are closed as worker lost, and each recorded artifact is looked at by its size
    and modification time (its bytes are hashed only where these differ). After an unclean end as well: part files are
    swept away, and receipts that the record lacks are adopted. Artifacts whose file vanished are dropped from the
    record.

    The caller holds the job's lease; `clean` is what `Manifest.begin_run` returned.
    """
    sentences = [*_close_open_attempts(manifest)]
    if not clean:
        swept = sweep_parts(layout)
        if swept:
            sentences.append(f"swept away {counted(len(swept), 'unfinished file')}")
        adopted = _adopt_receipts(manifest, layout)
        if adopted:
            sentences.append(f"found {counted(adopted, 'finished file')} that the record did not know yet")
    rows = manifest.artifacts()
    inspection = inspect_files(layout, rows)
    rows.update({receipt.artifact: artifact_row(receipt) for receipt in inspection.newer_receipts})
    for path, mtime_ns in inspection.new_mtimes_ns.items():
        rows[path] = rows[path]._replace(mtime_ns=mtime_ns)
    missing = [path for path, problem in inspection.problems.items() if problem.condition is FileCondition.MISSING]
    with manifest.transaction():
        manifest.record_artifacts(inspection.newer_receipts)
        manifest.adopt_mtimes(inspection.new_mtimes_ns)
        manifest.forget_artifacts(missing)
        for path, problem in inspection.problems.items():
            if problem.condition is FileCondition.EDITED:
                sentences.append(f"{path}: {problem.reason}")
                manifest.log_event("edited", sentences[-1], task=rows[path].task)
    return Reconciliation(rows, inspection.problems, tuple(sentences))


def inspect_files(layout: JobLayout, rows: Mapping[ArtifactPath, ArtifactRow]) -> Inspection:
    """Compare the recorded artifacts with their files; changes nothing, so `plan` may call it beside a runner."""
    problems: dict[ArtifactPath, FileProblem] = {}
    new_mtimes_ns: dict[ArtifactPath, int] = {}
    newer_receipts: list[Receipt] = []
    root = str(layout.root)
    for artifact, row in rows.items():
        try:
            status = os.stat(f"{root}/{artifact}")  # noqa: PTH116 - 100,000 Path objects would take half of the time
        except (FileNotFoundError, NotADirectoryError):
            problems[artifact] = FileProblem(FileCondition.MISSING, "file is missing")
            continue
        if status.st_mtime_ns == row.mtime_ns and status.st_size == row.size:
            continue
        receipt = read_receipt(layout, artifact)
        if status.st_size == row.size and hash_file(layout.path(artifact)) == row.hash:
            if receipt is None:
                problems[artifact] = FileProblem(FileCondition.INTERRUPTED, "its receipt is missing or damaged")
                continue
            if artifact_row(receipt)._replace(mtime_ns=row.mtime_ns) == row:
                new_mtimes_ns[artifact] = status.st_mtime_ns
                continue
        if receipt is None:
            problems[artifact] = FileProblem(FileCondition.INTERRUPTED, "its commit was cut short")
            continue
        finding = verify_artifact(layout, receipt)
        if finding is None:
            newer_receipts.append(receipt)
        else:
            problems[artifact] = FileProblem(FileCondition.EDITED, _describe_edit(layout, artifact, finding))
    return Inspection(problems, new_mtimes_ns, tuple(newer_receipts))


def rebuild_manifest(layout: JobLayout) -> tuple[Path | None, int]:
    """Make a new manifest of the receipts; the caller holds the job's lease.

    Artifacts and the numbers of their attempts come back; logs of attempts, events and old parameter sets do not.

    Returns:
        Where the old manifest was moved to (None if there was none), and how many artifacts the new one knows.
    """
    kept = _move_aside(layout.manifest)
    with Manifest(layout.manifest) as manifest:
        reconcile(manifest, layout, clean=False)
        return kept, len(manifest.artifacts())


def receipts(layout: JobLayout) -> Iterator[Receipt]:
    """Every readable receipt of the job's folder."""
    root = str(layout.receipts)
    for folder, _, names in os.walk(root):
        prefix = folder[len(root) + 1 :]
        for name in names:
            if name.endswith(".json"):
                artifact = ArtifactPath(os.path.join(prefix, name.removesuffix(".json")))  # noqa: PTH118 - as above
                receipt = read_receipt(layout, artifact)
                if receipt is not None:
                    yield receipt


def _close_open_attempts(manifest: Manifest) -> Iterator[str]:
    lost = manifest.running_attempts()
    if not lost:
        return
    with manifest.transaction():
        for attempt in lost:
            manifest.finish_attempt(
                attempt.task,
                attempt.number,
                failure=FailureKind.WORKER_LOST,
                message="the runner ended before the attempt did",
                state=TaskState.PENDING,
            )
    yield f"{counted(len(lost), 'attempt')} ended with the last runner, first {lost[0].task}; each starts again"


def _adopt_receipts(manifest: Manifest, layout: JobLayout) -> int:
    """Record what has been committed without the record learning of it; returns how many files."""
    rows = manifest.artifacts()
    unknown = [receipt for receipt in receipts(layout) if not _is_known(receipt, rows)]
    adopted = [receipt for receipt in unknown if verify_artifact(layout, receipt) is None]
    with manifest.transaction():
        manifest.remember_attempts(unknown)
        manifest.record_artifacts(adopted)
    return len(adopted)


def _is_known(receipt: Receipt, rows: Mapping[ArtifactPath, ArtifactRow]) -> bool:
    row = rows.get(receipt.artifact)
    identity = attrgetter("task", "attempt", "fingerprint", "hash")
    return row is not None and identity(row) == identity(receipt)


def _describe_edit(layout: JobLayout, artifact: ArtifactPath, finding: str) -> str:
    if layout.path(artifact).stat().st_size == 0:
        return finding
    return f"{finding}; before it is made anew it is kept as {edited_name(layout, artifact)}"


def _move_aside(manifest: Path) -> Path | None:
    """Rename a manifest with its journal, so that SQLite still finds both together."""
    if not manifest.exists():
        return None
    number = 1
    while (kept := manifest.with_name(f"{manifest.name}.damaged-{number}")).exists():
        number += 1
    for suffix in ("-wal", "-shm", "-journal", ""):
        part = manifest.with_name(f"{manifest.name}{suffix}")
        if part.exists():
            part.rename(f"{kept}{suffix}")
    return kept


# --- on request ---


def flaws_of(layout: JobLayout, *, deep: bool) -> tuple[int, dict[str, str]]:
    """How many files of a job were checked, and what is wrong with which; `deep` compares contents.

    Raises PipelineError: something is in the place of a file or a folder of the job.
    """
    flaws: dict[str, str] = {}
    committed = {receipt.artifact: receipt for receipt in receipts(layout)}
    rows: dict[ArtifactPath, ArtifactRow] = {}
    if layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            rows = manifest.artifacts()
    check_places(layout, committed.keys() | rows.keys())
    for artifact, receipt in committed.items():
        flaw = verify_artifact(layout, receipt, deep=deep)
        if flaw is not None:
            flaws[artifact] = flaw
    for artifact, row in rows.items():
        if artifact not in committed:
            flaws.setdefault(artifact, "its receipt is missing or damaged")
        elif deep and artifact_row(committed[artifact])._replace(mtime_ns=row.mtime_ns) != row:
            flaws.setdefault(artifact, "the record says something else than its receipt")
    return len(committed.keys() | rows.keys()), flaws


def restore_text(layout: JobLayout, path: Path) -> bool:
    """Rewrite a damaged text of the provenance from record or folder, else remove it; returns whether it was known."""
    text = None
    if path.parent == layout.parameters_text("").parent and layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            parameters = manifest.parameters(path.stem)
        text = None if parameters is None else parameters.canonical
    elif layout.job_file.exists():
        text = layout.job_file.read_bytes().decode(errors="replace")  # that of a damaged one has another digest
    path.unlink()
    if text is None or digest_of(text) != path.stem:
        return False
    replace_durably(path, text)
    return True


def mark_as_touched(path: Path) -> None:
    """Give a damaged file a modification time that its receipt does not know, if it is there and has not got one."""
    try:
        if path.exists():
            path.touch()
    except OSError as error:
        raise PipelineError(f"cannot mark {path} as damaged: {error.strerror}; remove it before resuming") from error
