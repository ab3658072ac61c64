"""Commands that look after a job's files: verify, clean."""

from __future__ import annotations

import json
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import click

from pipeline import wording
from pipeline.commands.arguments import find_job, json_option, submitted_job_argument
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
    from pipeline.artifacts import verify_artifact
    from pipeline.lease import Lease
    from pipeline.reconcile import rebuild_manifest, receipts

    layout = find_job(job, output)
    if rebuild:
        with Lease.acquire(layout.lease):
            kept, count = rebuild_manifest(layout)
        aside = f"; the old one is {kept}" if kept else ""
        click.echo(f"{layout.manifest}: made of {count} receipts{aside}", err=as_json)
    checked = 0
    flaws: dict[str, str] = {}
    for receipt in receipts(layout):
        checked += 1
        flaw = verify_artifact(layout, receipt, deep=deep)
        if flaw is not None:
            flaws[receipt.artifact] = flaw
    if as_json:
        click.echo(json.dumps({"checked": checked, "deep": deep, "flaws": flaws}, indent=1))
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
    sys.exit(int(bool(flaws)))


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
@click.option("--all", "everything", is_flag=True, help="Remove the job's whole folder.")
@click.option("--yes", is_flag=True, help="Really remove; without it, only say what would go.")
def clean(job: str, output: Path, stages: tuple[str, ...], everything: bool, yes: bool) -> None:
    """Remove a job's files, by stage or all of them.

    Without --yes it only says what would go.

    \b
    pipeline clean quickstart --stage surface --stage volume
    pipeline clean quickstart --all --yes
    """
    from pipeline.lease import Lease, remove_guard

    if not stages and not everything:
        raise click.UsageError("say what to remove: --stage or --all")
    layout = find_job(job, output)
    if everything and not layout.manifest.exists():
        # A folder with somebody's job.toml in it, for all we know.
        raise PipelineError(f"{layout.root} holds no finished work of a job; remove it yourself if you mean to")
    with Lease.acquire(layout.lease):
        if everything:
            _remove_contents(layout, really=yes)
        else:
            _remove_stages(layout, frozenset(stages), really=yes)
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


def _remove_stages(layout: JobLayout, stages: frozenset[str], *, really: bool) -> None:
    from pipeline.job.loading import load_job
    from pipeline.manifest import Manifest
    from pipeline.plan import plan_job
    from pipeline.stages import STAGES

    known = [stage.name for stage in STAGES]
    unknown = sorted(stages - set(known))
    if unknown:
        raise PipelineError(f'no stage "{unknown[0]}"; the stages are {", ".join(known)}')
    planned = {task.id for task in plan_job(load_job(layout.job_file), layout, STAGES) if task.stage in stages}
    with Manifest(layout.manifest) as manifest:
        artifacts = [
            artifact
            for artifact, row in manifest.artifacts().items()
            if row.task in planned or row.task.split("/")[0] in stages
        ]
        files = [layout.path(artifact) for artifact in artifacts]
        if "simulate" in stages:
            files += sorted(layout.checkpoints.glob("*.h5"))
        _announce(layout.root, files, really=really)
        if not really:
            return
        # Receipts go first: a file without one does not count, a receipt without its file would be a claim.
        for path in [*map(layout.receipt, artifacts), *files]:
            path.unlink(missing_ok=True)
        manifest.forget_artifacts(artifacts)


def _announce(folder: Path, files: list[Path], *, really: bool) -> None:
    size = sum(path.stat().st_size for path in files if path.exists())
    verb = "removing" if really else "would remove"
    click.echo(f"{verb} {len(files)} files, {wording.size(size)}, in {folder}")
    if not really and files:
        click.echo("nothing was removed; add --yes to do it")
