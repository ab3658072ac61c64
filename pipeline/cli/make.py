"""Commands that make films: new, check, plan, submit, rerun."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.base import wording
from pipeline.base.errors import PipelineError, StageUnavailableError
from pipeline.base.layout import JobLayout
from pipeline.base.wording import print_warnings
from pipeline.cli.arguments import (
    find_job,
    job_options,
    json_option,
    output_option,
    parse_frames,
    place,
    queue_options,
    submission_folder,
    submitted_job_argument,
    until_option,
)
from pipeline.queue.submitting import QueueOptions, run, say_aside
from pipeline.queue.submitting import submit as submit_to_queue

if TYPE_CHECKING:
    from pipeline.run.plan import Assessment

TEMPLATES = ("dam-break", "drop", "smoke", "cloth", "sand")
"""As in `pipeline.job.starter`, which is too heavy to be imported for `--help`."""


@click.command()
@click.argument("name", type=click.Path(path_type=Path))
@click.option("--template", type=click.Choice(TEMPLATES), default="dam-break", show_default=True, help="What happens.")
def new(name: Path, template: str) -> None:
    """Write a commented job file NAME.toml to start from.

    \b
    pipeline new my-film
    pipeline new jobs/plume --template smoke
    """
    from pipeline.job.starter import write_starter

    path = write_starter(name, template)
    click.echo(f"wrote {path}; next: pipeline submit {path} --preview")


@click.command()
@job_options
@until_option
@click.option("--json", "as_json", is_flag=True, help="Print the whole job, defaults included, as JSON.")
def check(job_file: Path, overrides: tuple[str, ...], preview: bool, until: tuple[str, ...], as_json: bool) -> None:
    """Say what is wrong with a job file, its size, and what it will take.

    \b
    pipeline check my-film
    pipeline check dam.toml --set fluid.water.particle_radius=0.005
    """
    from pipeline.kinds.table import KINDS
    from pipeline.model.problems import format_path
    from pipeline.queue.cost import describe, too_long
    from pipeline.queue.disk import size_of
    from pipeline.queue.submitting import first_cost
    from pipeline.run.checked_job import checked, needs_pictures, read_own_job

    loaded, findings = checked(read_own_job(job_file, overrides, preview=preview, until=until), until)
    print_warnings(loaded.warnings)
    if as_json:
        click.echo(loaded.job.model_dump_json(indent=2))
        return
    job = loaded.job
    warning = None
    try:
        expected, without_gpu = first_cost(job, size_of(job, findings), until)
        told, warning = describe(expected, without_gpu), too_long(expected, job)
    except StageUnavailableError as error:  # what cannot be planned here
        told = f"what it takes cannot be told here: {error}"
    click.echo(f"{job_file}: ok")
    click.echo(f"  {job.name}: {job.frame_count} frames, {job.film_s:.3g} s at {job.fps} fps")
    for kind in KINDS.values():
        if kind.size and kind.bodies(job):
            click.echo(f"  {kind.size.format(findings.elements[kind.name])}")
    for fact in findings.facts:
        click.echo(f"  {format_path(fact.path)} {fact.message}")
    if needs_pictures(until):
        width, height = job.render.resolution
        click.echo(f"  {width} x {height} pixels, {job.render.quality} quality")
    click.echo(f"  {told}")
    print_warnings([warning] if warning else [])


@click.command()
@job_options
@until_option
@output_option
@json_option
def plan(
    *, job_file: Path, overrides: tuple[str, ...], preview: bool, until: tuple[str, ...], output: Path, as_json: bool
) -> None:
    """Say what submitting a job would run, and why.

    Runs nothing.

    \b
    pipeline plan my-film
    pipeline plan my-film --until surface
    pipeline plan dam.toml --set 'camera.position=[0, -3, 1]'
    """
    from pipeline.queue.cost import both_ways, costs_here, describe, too_long
    from pipeline.queue.disk import size_of
    from pipeline.run.assessment import assess_job
    from pipeline.run.checked_job import checked, needs_pictures, read_own_job
    from pipeline.run.plan import Verdict, summarize

    loaded, findings = checked(read_own_job(job_file, overrides, preview=preview, until=until), until)
    layout = submission_folder(job_file, loaded.job.name, output, is_changed=bool(overrides) or preview)
    assessments, own, _ = assess_job(loaded.job, layout, until)
    if as_json:
        click.echo(json.dumps([assessment_as_json(each) for each in assessments], indent=1))
        return
    print_warnings(loaded.warnings)
    for line in summarize(assessments):
        click.echo(line)
    costs = costs_here(loaded.job, draws=needs_pictures(until), say=say_aside)
    expected, without_gpu = both_ways(loaded.job, assessments, size_of(loaded.job, findings), costs, own)
    for each in expected.stages:
        click.echo(f"{each.stage}: about {wording.rough_duration(each.seconds)} of work{' on a GPU' * each.on_gpu}")
    if expected.stages:
        click.echo(f"all: {describe(expected, without_gpu)}")
    print_warnings([warning for warning in (too_long(expected, loaded.job),) if warning])
    todo = sum(len(each.rebuilds) for each in assessments)
    at_most = "at most " if any(each.verdict is Verdict.DOWNSTREAM for each in assessments) else ""
    click.echo(f"{at_most}{todo} of {sum(len(each.task.outputs) for each in assessments)} files to make")


@click.command()
@job_options
@until_option
@output_option
@queue_options
def submit(
    *,
    job_file: Path,
    overrides: tuple[str, ...],
    preview: bool,
    until: tuple[str, ...],
    output: Path,
    options: QueueOptions,
) -> None:
    """Run a job until its film is there, or until a stage of it.

    Whatever is there already is kept. Submitted again after a crash, a kill or Ctrl-C, it continues. Submitted again
    after a change, it runs what the change concerns, and says so first. Jobs of the same output folder take turns: if
    another one runs, this one waits in the queue, and if this one runs already, that run is watched.

    With --until simulate, surface, volume or any other stage, only that stage and what it needs is made: data instead
    of a film, for which neither pictures nor a Blender are asked. Submitted without it later, the job goes on.

    \b
    pipeline submit my-film
    pipeline submit dam.toml --preview
    pipeline submit dam.toml --until surface
    pipeline submit dam.toml --set render.quality=final --set camera.f_stop=2.8
    pipeline submit dam.toml --detach --priority 10
    pipeline submit dam.toml --farm /shared/renders --scheduler tcp://farm:8786
    """
    from pipeline.record.interrupted_recording import complete_interrupted_recording
    from pipeline.run.checked_job import read_own_job

    if job_file.name == "job.toml" and (sentence := complete_interrupted_recording(JobLayout(job_file.parent))):
        click.echo(sentence, err=True)
    loaded = read_own_job(job_file, overrides, preview=preview, until=until)
    layout = submission_folder(job_file, loaded.job.name, output, is_changed=bool(overrides) or preview)
    sys.exit(submit_to_queue(loaded, layout, options=options, until=until))


@click.command()
@submitted_job_argument
@click.option("--failed", is_flag=True, help="The tasks that failed; of a running job when its other tasks have ended.")
@click.option("--stage", "stages", multiple=True, help="Only this stage; may be given several times.")
@click.option("--frames", metavar="RANGES", help="Only these frames: 7 or 0-29 or 0-29,60-89.")
@queue_options
def rerun(
    job: str, *, output: Path, failed: bool, stages: tuple[str, ...], frames: str | None, options: QueueOptions
) -> None:
    """Run again: failed tasks, or stages and frames that are done.

    What depends on them follows if they turn out different.

    \b
    pipeline rerun my-film --failed
    pipeline rerun my-film --stage render --frames 10-19
    pipeline rerun my-film --stage surface
    """
    from pipeline.job.loading import load_job
    from pipeline.run.control import Selection
    from pipeline.run.goal import read_goal
    from pipeline.run.plan import plan_job
    from pipeline.stages import STAGES

    if failed:
        if stages or frames is not None:
            raise click.UsageError("--failed means whatever failed; leave --stage and --frames out")
        sys.exit(_try_failed_again(job, output, options))
    if not stages and frames is None:
        raise click.UsageError("say what to run again: --failed, --stage, --frames, or the last two together")
    layout = find_job(job, output)
    selection = Selection(frozenset(stages), None if frames is None else parse_frames(frames))
    submitted = load_job(layout.job_file)
    if submitted.recorded is not None and "simulate" in stages:
        raise PipelineError(f"{submitted.name} is a recording ({submitted.recorded}): it cannot be simulated again")
    on_demand = [stage.name for stage in STAGES if stage.on_demand and stage.name in stages]
    until = tuple(name if frames is None else f"{name}:{frames}" for name in on_demand) or read_goal(layout)
    tasks = plan_job(submitted, layout, STAGES, until)
    selection.of(tasks)  # refuses now what is not in the plan, not when its turn comes
    todo = frozenset(task.stage for task in tasks)
    sys.exit(run(submitted, layout, todo, options=options, rerun=selection, until=until))


def _try_failed_again(job: str, output: Path, options: QueueOptions) -> int:
    from pipeline.queue.changes import another_try
    from pipeline.queue.turns import as_given, stand_in_queue

    queue, name = place(job, output)
    again = options.applied_to(another_try(queue, name, background=options.detach))
    return stand_in_queue(queue, as_given(queue.layout(name)), again, detach=options.detach)


def assessment_as_json(assessment: Assessment) -> dict[str, Any]:
    """A task's verdict, for `--json`."""
    return {
        "task": assessment.task.id,
        "stage": assessment.task.stage,
        "frame": assessment.task.frame,
        "verdict": assessment.verdict.value,
        "reasons": [reason.text for reason in assessment.reasons],
        "rebuilds": list(assessment.rebuilds),
    }
