"""Commands for farms that have a manager of their own: export, run-stage."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import FrameType

import click

from pipeline.commands.arguments import (
    find_job,
    job_options,
    output_option,
    parse_frames,
    print_warnings,
    require_own_programs,
    submitted_job_argument,
)
from pipeline.commands.executing import require_named_devices
from pipeline.errors import DiskFullError
from pipeline.layout import JobLayout

STOPPED_EXIT_CODE = 143
"""As shells report a program that SIGTERM ended."""
FAILED_EXIT_CODE = 5


@click.group()
def export() -> None:
    """Hand a job over to another farm manager.

    \b
    pipeline export openjd jobs/dam_break.toml --output /shared/renders
    """


@export.command()
@job_options
@output_option
@click.option(
    "--python",
    default=sys.executable,
    help="The interpreter with this program on the farm's machines; the present one if omitted.",
)
def openjd(job_file: Path, overrides: tuple[str, ...], preview: bool, output: Path, python: str) -> None:
    """Write an Open Job Description template, and the job's folder that it works in.

    A step for each stage, cut into chunks of frames where frames do not depend on each other. The folder must lie on a
    disk that all machines share; the template lies in it. What the farm has made, `pipeline resume` takes over.

    \b
    pipeline export openjd jobs/dam_break.toml --output /shared/renders
    openjd check /shared/renders/dam_break/openjd.json
    openjd run /shared/renders/dam_break/openjd.json --step movie --run-dependencies
    """
    from pipeline.files import replace_durably
    from pipeline.job.checks import load_checked_job
    from pipeline.job.inputs import keep_inputs
    from pipeline.lease import refuse_if_held
    from pipeline.openjd import job_template
    from pipeline.plan import plan_job
    from pipeline.stages import STAGES

    loaded, _ = load_checked_job(job_file, overrides, preview=preview)
    require_own_programs(loaded, overrides)
    require_named_devices(loaded.job, [stage.name for stage in STAGES])
    print_warnings(loaded.warnings)
    layout = JobLayout((output / loaded.job.name).absolute())
    refuse_if_held(layout.lease)
    layout.root.mkdir(parents=True, exist_ok=True)
    job, text = keep_inputs(loaded, layout)
    replace_durably(layout.job_file, text)
    described = job_template(job.name, plan_job(job, layout, STAGES), python=python)
    path = layout.root / "openjd.json"
    replace_durably(path, json.dumps(described, indent=2, ensure_ascii=False) + "\n")
    click.echo(f"wrote {path}; its job's folder is {layout.root}")


@click.command("run-stage")
@submitted_job_argument
@click.option("--stage", required=True, help="The stage.")
@click.option("--frames", metavar="RANGES", help="Only these frames: 7 or 0-29 or 0-29,60-89; all if omitted.")
@click.option("--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all if omitted.")
@click.option("--openjd", is_flag=True, help="Tell progress the way Open Job Description has it.")
def run_stage(job: str, *, output: Path, stage: str, frames: str | None, cores: int | None, openjd: bool) -> None:
    """Run one stage of a job, or some frames of it, here and now.

    For other farm managers: there is no queue, no record and no second try, and any number of machines may work on
    different frames of a job at once. What is done is not done again. What the stage reads must be there.

    Exits with 0 when all is there, 5 after a failure, 7 when the disk is full, and 143 when it was stopped by SIGTERM,
    after which it continues.

    \b
    pipeline run-stage quickstart --stage render --frames 0-9
    """
    from dataclasses import replace

    from pipeline.executors.worker_process import THREAD_VARIABLES
    from pipeline.job.loading import load_job
    from pipeline.lease import refuse_if_held
    from pipeline.resources import machine_capacity
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stage_run import run_stage as run
    from pipeline.task import FailureKind

    layout = JobLayout(find_job(job, output).root.absolute())
    refuse_if_held(layout.lease)
    capacity = machine_capacity(gpus=1)
    capacity = replace(capacity, cores=min(cores or capacity.cores, capacity.cores))
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(capacity.cores)))  # before anything reads them
    stopped = []

    def stop(_number: int, _frame: FrameType | None) -> None:
        stopped.append(True)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    outcome = run(
        load_job(layout.job_file),
        layout,
        stage,
        None if frames is None else parse_frames(frames),
        capacity=capacity,
        stages=STAGES_REFERENCE,
        stop_requested=lambda: bool(stopped),
        tell=_tell_openjd if openjd else _tell,
    )
    for failed in outcome.failures:
        click.secho(f"{failed.task_id}: {failed.message}", err=True, fg="red")
    click.echo(
        f"{stage}: {outcome.ran} tasks ran, {outcome.up_to_date} were up to date, {len(outcome.failures)} failed"
    )
    if stopped:
        sys.exit(STOPPED_EXIT_CODE)
    if outcome.failures:
        full = any(failed.kind is FailureKind.DISK_FULL for failed in outcome.failures)
        sys.exit(DiskFullError.exit_code if full else FAILED_EXIT_CODE)


def _tell(share: float, sentence: str) -> None:
    click.echo(f"{100 * share:.0f} %  {sentence}", err=True)


def _tell_openjd(share: float, sentence: str) -> None:
    """Lines of the specification "How Jobs Are Run", on standard output."""
    print(f"openjd_progress: {100 * share:.1f}", flush=True)
    print(f"openjd_status: {sentence}", flush=True)
