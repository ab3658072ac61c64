"""What a command says when a job has ended, and the report that it leaves then."""

import click

from pipeline.base import wording
from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.wording import print_warnings
from pipeline.model.job import Job
from pipeline.queue.states import ending_of
from pipeline.run.events import JobOutcome, Outcome
from pipeline.run.goal import read_goal, what_is_made
from render.temporary_folder import remove_folders_of_the_dead


def tell_end(job: Job, layout: JobLayout, outcome: Outcome, *, aside: bool = False) -> None:
    """Say how a run ended; of a job that is not this command's own, on standard error."""
    film = layout.path(layout.movie(job.movie.suffix))
    if outcome.kind is not JobOutcome.SUCCEEDED:
        how = f"{ending_of(outcome.kind)} after {wording.duration(outcome.seconds)}"
        click.secho(f"{job.name}: {how}", err=True, fg="red")
        for failed in outcome.failures[:5]:
            click.echo(f"  {failed.task_id}: {failed.message}", err=True)
            click.echo(f"    pipeline explain {layout.root} {failed.task_id} --log", err=True)
        click.echo(f"continue with: pipeline resume {layout.root}", err=True)
    elif outcome.ran == 0:
        click.echo(f"up to date: {what_is_made(layout)}", err=aside)
    elif read_goal(layout):
        click.echo(f"{what_is_made(layout)}: done in {wording.duration(outcome.seconds)}", err=aside)
    else:
        click.echo(
            f"{film}: {job.frame_count} frames, {job.frame_count / (job.movie.playback_fps or job.fps):.3g} s of film, "
            f"in {wording.duration(outcome.seconds)}",
            err=aside,
        )
    if outcome.ran or outcome.failures:
        from pipeline.run.solver_numbers import simulation_numbers

        print_warnings([str(each) for each in simulation_numbers(layout).warnings()])
    if outcome.ran or outcome.failures or not layout.report.exists():
        _write_report(layout)


def say_finished(layout: JobLayout) -> None:
    """Say that there is nothing to do, and make good what a runner left undone that was killed after its last task."""
    remove_folders_of_the_dead()
    click.echo(f"up to date: {what_is_made(layout)}")
    if not layout.report.exists():
        _write_report(layout)


def _write_report(layout: JobLayout) -> None:
    """Leave the report in the job's folder. That it cannot be written is said, and changes nothing about the run."""
    from pipeline.show.report.page import write_report

    try:
        write_report([layout], layout.report)
    except (OSError, PipelineError) as error:
        print_warnings([f"no report was written: {error}"])
    else:
        click.echo(f"report: {layout.report}", err=True)
