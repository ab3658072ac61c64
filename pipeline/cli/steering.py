"""Commands that run a scene while somebody steers it: live."""

from __future__ import annotations

import math
from pathlib import Path

import click

from pipeline.base.console import print_warnings
from pipeline.cli.arguments import job_options, output_option, require_own_programs
from pipeline.cli.pages import address_options, require_pages


@click.command()
@job_options
@output_option
@address_options(8080)
@click.option("--substeps", type=click.IntRange(1, 200), help="Steps a frame of cloth: fewer are faster and softer.")
@click.option("--as-written", is_flag=True, help="Keep the job's substeps and self-collisions, however slow.")
@click.option("--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all if omitted.")
@click.option("--paused", is_flag=True, help="Begin standing still.")
@click.option("--anyway", is_flag=True, help="Run a scene that is too large to steer, too.")
def live(
    job_file: Path,
    *,
    overrides: tuple[str, ...],
    preview: bool,
    output: Path,
    port: int,
    host: str,
    substeps: int | None,
    as_written: bool,
    cores: int | None,
    paused: bool,
    anyway: bool,
) -> None:
    """Run cloth, rigid bodies or a small fluid in a browser, as fast as this machine can, and change it.

    Cloth that is too large to be fluent takes fewer substeps, and then does not collide with itself: the page says so,
    its controls bring both back, and --as-written or --substeps keeps to what the job or you say.

    Bodies, pins and cloth are dragged with the mouse; sliders change what they are made of. "Save as job" writes the
    values into a new job file in the present folder; "Record" makes a recording that `pipeline submit` renders.
    Ends with Ctrl-C.

    \b
    pipeline live jobs/ball_into_cloth.toml
    pipeline live jobs/cloth_over_sphere.toml --set cloth.sheet.shape.counts=[65,65] --substeps 10
    pipeline live dam.toml --preview --port 0
    """
    from pipeline.base.resources import machine_capacity
    from pipeline.job.loading import read_job
    from pipeline.run.checked_job import load_checked_job
    from pipeline.web.live.admission import computing_power, live_job, require_small
    from pipeline.web.live.frame_timer import LONGEST_FRAME_S
    from pipeline.web.live.parameters import parameters_of
    from pipeline.web.live.step_size import fluent, told_changes
    from sim.core.runtime import resolve_device

    if as_written and substeps is not None:
        raise click.UsageError("--as-written keeps the job's substeps, and --substeps changes them; give one of them")
    require_pages()
    loaded = read_job(job_file, overrides, preview=preview)
    require_own_programs(loaded, overrides)
    job = live_job(loaded.job, substeps=substeps)
    loaded, findings = load_checked_job(job_file, overrides, preview=preview)
    threads, on_gpu = cores or machine_capacity().cores, resolve_device(job.device) != "cpu"
    if not as_written and substeps is None:
        job = fluent(job, power=computing_power(cores=threads, on_gpu=on_gpu))
    if not anyway:
        require_small(job, findings.elements["fluid"], cores=threads, on_gpu=on_gpu)
    print_warnings(loaded.warnings)
    if told := told_changes(loaded.job, {parameter.name: parameter.start for parameter in parameters_of(job)}):
        click.echo(told)

    from pipeline.web.live.running import show_live
    from pipeline.web.serving import stop_event

    with stop_event() as stop:
        show_live(
            loaded,
            job,
            host=host,
            port=port,
            gave_up=bool(told) and substeps is None,
            longest_frame_s=math.inf if anyway else LONGEST_FRAME_S,
            output=output,
            folder=Path.cwd(),
            threads=cores,
            paused=paused,
            say=click.echo,
            ends=stop.is_set,
        )
