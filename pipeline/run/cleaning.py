"""Files of a job that are to go: by stage and age, those of no use any more, or all."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.places import check_places
from pipeline.base.task import ArtifactPath, TaskId
from pipeline.job.loading import load_job
from pipeline.record.manifest import Manifest
from pipeline.run.plan import plan_job
from pipeline.store.receipts import FILE_IS_MISSING, read_receipt, verify_artifact


def remove_contents(layout: JobLayout, is_meant: Callable[[list[Path]], bool]) -> None:
    """Remove everything but the files of the lease, which the caller holds, if `is_meant` says so of the files."""
    files = [path for path in layout.root.rglob("*") if path.is_file() and not layout.is_of_lease(path)]
    if not is_meant(files):
        return
    for path in layout.root.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif not layout.is_of_lease(path):
            path.unlink()


@dataclass(frozen=True)
class Choice:
    """What is to go: files of stages, checkpoints, what is superseded; of these only what is older than `age_s` [s]."""

    stages: frozenset[str]
    checkpoints: bool
    superseded: bool
    age_s: float | None


def remove_chosen(layout: JobLayout, choice: Choice, is_meant: Callable[[list[Path]], bool]) -> dict[ArtifactPath, str]:
    """Remove files of a job by choice, with their receipts and rows; see `remove_contents`.

    Returns:
        Artifacts that stay, because their files are not what was committed, each with what is wrong.

    Raises PipelineError: there is no such stage, its files could never be made anew, or something is in the place of a
        file or a folder of the job.
    """
    from pipeline.stages import STAGES

    known = [stage.name for stage in STAGES]
    unknown = sorted(choice.stages - set(known))
    if unknown:
        raise PipelineError(f'no stage "{unknown[0]}"; the stages are {", ".join(known)}')
    job = load_job(layout.job_file)
    if job.recorded is not None and "simulate" in choice.stages:
        raise PipelineError(
            f"{job.name} is a recording ({job.recorded}): nothing can make its frames anew; --all removes the folder"
        )
    tasks = plan_job(job, layout, STAGES)
    planned = {output for task in tasks for output in task.outputs}
    asked = {stage.name for stage in STAGES if stage.on_demand}  # what was once asked for is not superseded
    theirs = {task.id for task in tasks if task.stage in choice.stages}
    with Manifest(layout.manifest) as manifest:
        rows = manifest.artifacts()
        check_places(layout, rows)
        artifacts = [
            artifact
            for artifact, row in rows.items()
            if row.task in theirs
            or row.task.split("/")[0] in choice.stages
            or (
                choice.superseded
                and artifact not in planned
                and row.task.split("/")[0] not in asked
                and (job.recorded is None or row.task != "simulate")
            )
        ]
        others: list[Path] = []
        if choice.checkpoints or "simulate" in choice.stages:
            others += sorted(layout.checkpoints.glob("*.h5"))
        if choice.superseded:
            others += superseded_logs(layout)
        if choice.age_s is not None:
            before = time.time() - choice.age_s
            artifacts = [artifact for artifact in artifacts if _is_older(layout.path(artifact), before)]
            others = [path for path in others if _is_older(path, before)]
        flaws = {each: verify_artifact(layout, read_receipt(layout, each) or rows[each]) for each in artifacts}
        edited = {each: flaw for each, flaw in flaws.items() if flaw is not None and flaw != FILE_IS_MISSING}
        artifacts = [artifact for artifact in artifacts if artifact not in edited]
        files = [*map(layout.path, artifacts), *others]
        if not is_meant(files):
            return edited
        # Receipts go first: a file without one does not count, a receipt without its file would be a claim.
        for path in [*map(layout.receipt, artifacts), *files]:
            path.unlink(missing_ok=True)
        manifest.forget_artifacts(artifacts)
        return edited


def superseded_logs(layout: JobLayout) -> list[Path]:
    """The logs of attempts that a later one of the same task has followed."""
    last: dict[TaskId, tuple[int, Path]] = {}
    older = []
    for task, number, path in layout.logs():
        attempt = (number, path)
        if task in last:
            older.append(min(attempt, last[task])[1])
        last[task] = max(attempt, last.get(task, attempt))
    return older


def _is_older(path: Path, before: float) -> bool:
    """Whether a file was last changed before a wall time [s]; one that is gone was."""
    try:
        return path.stat().st_mtime < before
    except FileNotFoundError:
        return True
