"""Files of a job held against their receipts and the record, and marks on those that are not as committed."""

from __future__ import annotations

from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import digest_of
from pipeline.record.manifest import artifact_row
from pipeline.record.reader import ManifestReader
from pipeline.record.reconcile import receipts
from pipeline.store.receipts import verify_artifact


def flaws_of(layout: JobLayout, *, deep: bool) -> tuple[int, dict[str, str]]:
    """How many files of a job were checked, and what is wrong with which; `deep` compares contents."""
    flaws: dict[str, str] = {}
    seen = {}
    for receipt in receipts(layout):
        flaw = verify_artifact(layout, receipt, deep=deep)
        if flaw is not None:
            flaws[receipt.artifact] = flaw
        seen[receipt.artifact] = artifact_row(receipt)
    if layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            rows = manifest.artifacts()
        for artifact, row in rows.items():
            if artifact not in seen:
                flaws.setdefault(artifact, "its receipt is missing or damaged")
            elif deep and seen[artifact]._replace(mtime_ns=row.mtime_ns) != row:
                flaws.setdefault(artifact, "the record says something else than its receipt")
        seen.update(rows)
    return len(seen), flaws


def restore_text(layout: JobLayout, path: Path) -> bool:
    """Rewrite a damaged text of the provenance from record or folder, else remove it; returns whether it was known."""
    text = None
    if path.parent == layout.parameters_text("").parent and layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            parameters = manifest.parameters(path.stem)
        text = None if parameters is None else parameters.canonical
    elif layout.job_file.exists():
        text = layout.job_file.read_text(encoding="utf-8")
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
