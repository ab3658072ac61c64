"""Commands that keep things in order: verify, clean, doctor, schema."""

import json
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import click

from pipeline.base import wording
from pipeline.base.errors import PipelineError
from pipeline.base.task import ArtifactPath
from pipeline.cli.arguments import find_job, json_option, output_option, parse_age, submitted_job_argument


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
    pipeline verify my-film
    pipeline verify my-film --deep
    """
    from pipeline.base.lease import Lease
    from pipeline.record.reconcile import flaws_of, mark_as_touched, rebuild_manifest, restore_text
    from pipeline.store.provenance import damaged_texts

    layout = find_job(job, output)
    if rebuild:
        with Lease.acquire(layout.lease):
            kept, count = rebuild_manifest(layout)
        aside = f"; the old one is {kept}" if kept else ""
        click.echo(f"{layout.manifest}: made of {count} receipts{aside}", err=as_json)
    checked, flaws = flaws_of(layout, deep=deep)
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
            mark_as_touched(layout.path(ArtifactPath(artifact)))
        for text in texts:
            how = "written anew" if restore_text(layout, layout.root / text) else "removed; nothing else knows it"
            click.secho(f"{text}: is not what its name says; {how}", fg="red", err=as_json)
    sys.exit(int(bool(flaws or texts)))


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
    """Remove files of a job by stage and age, useless ones, or all.

    Without --yes it only says what would go. Of single stages, files that somebody has edited stay.

    \b
    pipeline clean my-film --stage surface --stage volume
    pipeline clean my-film --stage render --older-than 7d --yes
    pipeline clean my-film --superseded --checkpoints --yes
    pipeline clean my-film --all --yes
    """
    from pipeline.base.lease import Lease, remove_guard
    from pipeline.run.cleaning import Choice, remove_chosen, remove_contents

    if not (stages or checkpoints or superseded or everything):
        raise click.UsageError("say what to remove: --stage, --checkpoints, --superseded or --all")
    if everything and age_s is not None:
        raise click.UsageError("--all removes the folder, whatever its age; choose stages for --older-than")
    layout = find_job(job, output)
    if everything and not layout.manifest.exists():
        # A folder with somebody's job.toml in it, for all we know.
        raise PipelineError(f"{layout.root} holds no finished work of a job; remove it yourself if you mean to")

    def is_meant(files: list[Path]) -> bool:
        size = sum(path.stat().st_size for path in files if path.exists())
        click.echo(
            f"{'removing' if yes else 'would remove'} {len(files)} files, {wording.size(size)}, in {layout.root}"
        )
        if not yes and files:
            click.echo("nothing was removed; add --yes to do it")
        return yes

    with Lease.acquire(layout.lease):
        if everything:
            remove_contents(layout, is_meant)
        else:
            choice = Choice(frozenset(stages), checkpoints=checkpoints, superseded=superseded, age_s=age_s)
            for artifact, flaw in remove_chosen(layout, choice, is_meant).items():
                click.echo(f"{artifact} stays: {flaw}")
    if everything and yes:
        remove_guard(layout.lease)
        with suppress(OSError):  # not empty: a job that was submitted in this moment has the folder now
            layout.root.rmdir()


@click.command()
@output_option
@json_option
def doctor(output: Path, as_json: bool) -> None:
    """Examine this machine: devices, libraries, Blender, memory, disk.

    Exits with 1 if something that every job needs is missing.

    \b
    pipeline doctor
    pipeline doctor --farm /data/renders --json
    """
    from pipeline.show.doctor import examine, print_report

    examinations = examine(output)
    if as_json:
        click.echo(json.dumps([asdict(each) for each in examinations], indent=2, ensure_ascii=False))
    else:
        print_report(examinations)
    sys.exit(int(any(each.status == "failed" for each in examinations)))


@click.command()
def schema() -> None:
    """Print the JSON Schema of the job file.

    Editors complete and check TOML with it.

    \b
    pipeline schema > job.schema.json      then, as a job file's first line:   #:schema job.schema.json
    """
    from pipeline.job.schema import job_schema

    click.echo(json.dumps(job_schema(), indent=2, ensure_ascii=False))
