"""The command line: parse, call, print. Importing this module loads neither the physics nor Blender."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from pipeline import __version__
from pipeline.commands.arguments import job_options, print_warnings, require_own_programs
from pipeline.commands.dashboard import dashboard
from pipeline.commands.exporting import export, run_stage
from pipeline.commands.inspecting import explain, logs, plan, status
from pipeline.commands.keeping import clean, verify
from pipeline.commands.previewing import animatic, still
from pipeline.commands.queueing import cancel, pause, priority, queue, retry, watch, work
from pipeline.commands.running import rerun, resume, submit
from pipeline.commands.showing import compare, loop, report, sheet
from pipeline.commands.steering import live
from pipeline.commands.viewing import view
from pipeline.errors import PLACE_TROUBLES, DiskFullError, PipelineError
from pipeline.executors.failures import is_disk_full

TEMPLATES = ("dam-break", "drop", "smoke", "cloth")
"""As in `pipeline.job.starter`, which is too heavy to be imported for `--help`."""


class PipelineGroup(click.Group):
    """Prints the errors that are meant for people as lines, without a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a `PipelineError` decides the exit code."""
        try:
            return super().invoke(ctx)
        except PipelineError as error:
            for line in str(error).splitlines():
                click.secho(f"error: {line}", err=True, fg="red")
            ctx.exit(error.exit_code)
        except OSError as error:
            if error.errno not in PLACE_TROUBLES:
                raise
            place = f"{error.filename}: " if error.filename else ""
            click.secho(f"error: {place}{error.strerror}; what is finished stays: try again later", err=True, fg="red")
            ctx.exit(DiskFullError.exit_code if is_disk_full(error) else PipelineError.exit_code)


@click.group(
    cls=PipelineGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Start with: pipeline new my-film, then: pipeline submit my-film.toml",
)
@click.version_option(package_name=None, version=__version__, prog_name="pipeline")
def main() -> None:
    """From a job file to a film of simulated physics, resumable after any crash."""


for command in (
    *(submit, plan, status, rerun, resume, logs, explain, verify, clean, sheet, report, still, animatic, compare, loop),
    *(queue, watch, pause, cancel, retry, priority, work),
    *(live, view, dashboard, export, run_stage),
):
    main.add_command(command)


@main.command()
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


@main.command()
@job_options
@click.option("--json", "as_json", is_flag=True, help="Print the whole job, defaults included, as JSON.")
def check(job_file: Path, overrides: tuple[str, ...], preview: bool, as_json: bool) -> None:
    """Say what is wrong with a job file, and how large the job is.

    \b
    pipeline check jobs/quickstart.toml
    pipeline check dam.toml --set fluid.water.particle_radius=0.005
    """
    from pipeline.job.checks import load_checked_job
    from pipeline.job.loading import read_job

    require_own_programs(read_job(job_file, overrides, preview=preview), overrides)
    loaded, findings = load_checked_job(job_file, overrides, preview=preview)
    print_warnings(loaded.warnings)
    if as_json:
        click.echo(loaded.job.model_dump_json(indent=2))
        return
    job = loaded.job
    width, height = job.render.resolution
    click.echo(f"{job_file}: ok")
    click.echo(f"  {job.name}: {job.frame_count} frames, {job.frame_count / job.fps:.3g} s at {job.fps} fps")
    if job.fluid:
        click.echo(f"  about {findings.particles:,} particles")
    if job.smoke:
        click.echo(f"  {findings.cells:,} smoke cells")
    if job.cloth:
        click.echo(f"  {findings.nodes:,} cloth nodes")
    click.echo(f"  {width} x {height} pixels, {job.render.quality} quality")


@main.command()
def schema() -> None:
    """Print the JSON Schema of the job file.

    Editors complete and check TOML with it.

    \b
    pipeline schema > job.schema.json      then, as a job file's first line:   #:schema job.schema.json
    """
    from pipeline.job.schema import job_schema

    click.echo(json.dumps(job_schema(), indent=2, ensure_ascii=False))


@main.command()
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    default=Path("renders"),
    show_default=True,
    help="Folder that results go to.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def doctor(output: Path, as_json: bool) -> None:
    """Look at this machine: devices, libraries, Blender, memory, disk.

    Exits with 1 if something that every job needs is missing.

    \b
    pipeline doctor
    pipeline doctor --output /data/renders --json
    """
    from pipeline.doctor import examine, print_report

    examinations = examine(output)
    if as_json:
        click.echo(json.dumps([each.as_json() for each in examinations], indent=2, ensure_ascii=False))
    else:
        print_report(examinations)
    sys.exit(int(any(each.status == "failed" for each in examinations)))
