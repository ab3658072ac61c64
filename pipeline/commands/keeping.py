"""Commands that look after a job's files: verify, clean."""

from __future__ import annotations

import json
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import click

from pipeline import wording
from pipeline.commands.arguments import find_job, json_option, parse_age, submitted_job_argument
from pipeline.errors import PipelineError
from pipeline.layout import JobLayout
from pipeline.task import ArtifactPath


@click.command()
@submitted_job_argument
@click.option("--deep", is_flag=True, help="Read every file and compare its hash; finds any flipped bit.")
@click.option("--rebuild", is_flag=True, help="Make a new manifest of the receipts; the old one is kept aside.")
@json_option
def verify(job: str, output: Path, deep: bool, rebuild: bool, as_json: bool) -> None:
    """Check that every finished file is as it was committed.

    Submitting the job again makes anew what is not. Where only its bytes give a damaged file away, it gets a new
    modification time, so that submitting finds it too. Exits with 1 if something is wrong.

    \b
    pipeline verify quickstart
    pipeline verify quickstart --deep
    """
    from pipeline.lease import Lease
    from pipeline.provenance import damaged_texts
    from pipeline.reconcile import rebuild_manifest

    layout = find_job(job, output)
    if rebuild:
        with Lease.acquire(layout.lease):
            kept, count = rebuild_manifest(layout)
        aside = f"; the old one is {kept}" if kept else ""
        click.echo(f"{layout.manifest}: made of {count} receipts{aside}", err=as_json)
    checked, flaws = _flaws(layout, deep=deep)
    texts = [path.relative_to(layout.root).as_posix() for path in damaged_texts(layout)] if deep else []
    if as_json:
        click.echo(json.dumps({"checked": checked, "deep": deep, "flaws": flaws, "texts": texts}, indent=1))
    else:
        for artifact, flaw in sorted(flaws.items()):
            click.secho(f"{artifact}: {flaw}", fg="red")
        how = "by content" if deep else "by size and time (--deep compares contents)"
        click.echo(f"{checked} files checked {how}, {len(flaws)} not as committed")
        if flaws:
            click.echo(f"heal with: pipeline resume {layout.root}")
    if deep:
        for artifact in flaws:
            _mark_as_touched(layout.path(ArtifactPath(artifact)))
        for text in texts:
            how = "written anew" if _restore(layout, text) else "removed; nothing else knows it"
            click.secho(f"{text}: is not what its name says; {how}", fg="red", err=as_json)
    sys.exit(int(bool(flaws or texts)))


def _flaws(layout: JobLayout, *, deep: bool) -> tuple[int, dict[str, str]]:
    """How many files were checked, and what is wrong with which."""
    from pipeline.manifest import artifact_row
    from pipeline.manifest_reader import ManifestReader
    from pipeline.receipts import verify_artifact
    from pipeline.reconcile import receipts

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


def _restore(layout: JobLayout, text: str) -> bool:
    """Write a damaged text of the provenance anew, if the record or the folder knows it; else remove it."""
    from pipeline.manifest_reader import ManifestReader
    from pipeline.provenance import restore

    path = layout.root / text
    parameters = None
    if path.parent == layout.provenance / "parameters" and layout.manifest.exists():
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            parameters = manifest.parameters(path.stem)
    return restore(layout, path, parameters)


def _mark_as_touched(path: Path) -> None:
    """Give a damaged file a modification time that its receipt does not know, if it is there and has not got one."""
    try:
        if path.exists():
            path.touch()
    except OSError as error:
        raise PipelineError(f"cannot mark {path} as damaged: {error.strerror}; remove it before resuming") from error


@click.command()
@submitted_job_argument
@click.option("--stage", "stages", multiple=True, help="Remove the files of this stage; may be given several times.")
@click.option("--checkpoints", is_flag=True, help="Remove the simulation's checkpoints; a longer film starts it anew.")
@click.option("--superseded", is_flag=True, help="Remove files that the job has no use for any more, and old logs.")
@click.option(
    "--older-than", "age_s", metavar="AGE", callback=parse_age, help="Only files that are older, such as 12h or 7d."
)
@click.option("--all", "everything", is_flag=True, help="Remove the job's whole folder.")
@click.option("--yes", is_flag=True, help="Really remove; without it, only say what would go.")
def clean(
    job: str,
    output: Path,
    *,
    stages: tuple[str, ...],
    checkpoints: bool,
    superseded: bool,
    age_s: float | None,
    everything: bool,
    yes: bool,
) -> None:
    """Remove a job's files: by stage and age, what is of no use any more, or all of them.

    Without --yes it only says what would go.

    \b
    pipeline clean quickstart --stage surface --stage volume
    pipeline clean quickstart --stage render --older-than 7d --yes
    pipeline clean quickstart --superseded --checkpoints --yes
    pipeline clean quickstart --all --yes
    """
    from pipeline.lease import Lease, remove_guard

    if not (stages or checkpoints or superseded or everything):
        raise click.UsageError("say what to remove: --stage, --checkpoints, --superseded or --all")
    if everything and age_s is not None:
        raise click.UsageError("--all removes the folder, whatever its age; choose stages for --older-than")
    layout = find_job(job, output)
    if everything and not layout.manifest.exists():
        # A folder with somebody's job.toml in it, for all we know.
        raise PipelineError(f"{layout.root} holds no finished work of a job; remove it yourself if you mean to")
    with Lease.acquire(layout.lease):
        if everything:
            _remove_contents(layout, really=yes)
        else:
            choice = _Choice(frozenset(stages), checkpoints=checkpoints, superseded=superseded, age_s=age_s)
            _remove_chosen(layout, choice, really=yes)
    if everything and yes:
        remove_guard(layout.lease)
        with suppress(OSError):  # not empty: a job that was submitted in this moment has the folder now
            layout.root.rmdir()


def _remove_contents(layout: JobLayout, *, really: bool) -> None:
    """Everything but the lease's own files, which are needed to give it back."""
    files = [path for path in layout.root.rglob("*") if path.is_file() and not layout.is_of_lease(path)]
    _announce(layout.root, files, really=really)
    if not really:
        return
    for path in layout.root.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif not layout.is_of_lease(path):
            path.unlink()


@dataclass(frozen=True)
class _Choice:
    """What is to go: files of stages, checkpoints, what is superseded; of these only what is older than `age_s` [s]."""

    stages: frozenset[str]
    checkpoints: bool
    superseded: bool
    age_s: float | None


def _remove_chosen(layout: JobLayout, choice: _Choice, *, really: bool) -> None:
    from pipeline.job.loading import load_job
    from pipeline.manifest import Manifest
    from pipeline.plan import plan_job
    from pipeline.stages import STAGES

    known = [stage.name for stage in STAGES]
    unknown = sorted(choice.stages - set(known))
    if unknown:
        raise PipelineError(f'no stage "{unknown[0]}"; the stages are {", ".join(known)}')
    job = load_job(layout.job_file)
    if job.recorded is not None and "simulate" in choice.stages:
        raise PipelineError(
            f"{job.name} is a live take ({job.recorded}): nothing can make its frames anew; --all removes the folder"
        )
    tasks = plan_job(job, layout, STAGES)
    planned = {output for task in tasks for output in task.outputs}
    theirs = {task.id for task in tasks if task.stage in choice.stages}
    with Manifest(layout.manifest) as manifest:
        artifacts = [
            artifact
            for artifact, row in manifest.artifacts().items()
            if row.task in theirs
            or row.task.split("/")[0] in choice.stages
            or (choice.superseded and artifact not in planned and (job.recorded is None or row.task != "simulate"))
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
        files = [*map(layout.path, artifacts), *others]
        _announce(layout.root, files, really=really)
        if not really:
            return
        # Receipts go first: a file without one does not count, a receipt without its file would be a claim.
        for path in [*map(layout.receipt, artifacts), *files]:
            path.unlink(missing_ok=True)
        manifest.forget_artifacts(artifacts)


def superseded_logs(layout: JobLayout) -> list[Path]:
    """The logs of attempts that a later one of the same task has followed."""
    folder = layout.root / "logs"
    last: dict[str, tuple[int, Path]] = {}
    older = []
    for path in sorted(folder.rglob("*.log")):
        task, _, number = path.relative_to(folder).as_posix().removesuffix(".log").rpartition(".")
        if not number.isdigit():
            continue
        attempt = (int(number), path)
        if task in last:
            older.append(min(attempt, last[task])[1])
        last[task] = max(attempt, last.get(task, attempt))
    return older


def _is_older(path: Path, before: float) -> bool:
    """Whether a file was last changed before a wall time [s since the epoch]; one that is gone was."""
    try:
        return path.stat().st_mtime < before
    except FileNotFoundError:
        return True


def _announce(folder: Path, files: list[Path], *, really: bool) -> None:
    size = sum(path.stat().st_size for path in files if path.exists())
    verb = "removing" if really else "would remove"
    click.echo(f"{verb} {len(files)} files, {wording.size(size)}, in {folder}")
    if not really and files:
        click.echo("nothing was removed; add --yes to do it")
