"""Commands that run a scene while somebody steers it: live."""

from __future__ import annotations

import math
from pathlib import Path

import click

from pipeline.commands.arguments import job_options, output_option, print_warnings, require_own_programs
from pipeline.commands.stopping import told_to_stop


@click.command()
@job_options
@output_option
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="0 takes a free one.")
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address of this machine alone; from others, ssh -L."
)
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
    """Run cloth, rigid bodies or a small fluid in a browser, as fast as this machine can, and play with it.

    Cloth that is too large to be fluent takes fewer substeps, and then does not collide with itself: the page says so,
    its knobs bring both back, and --as-written or --substeps keeps to what the job or you say.

    Bodies, pins and cloth are dragged with the mouse; sliders change what they are made of. "Save as job" writes the
    values into a new job file in the present folder; "Record" makes frames that `pipeline submit` renders. Ends with
    Ctrl-C.

    \b
    pipeline live jobs/ball_into_cloth.toml
    pipeline live jobs/cloth_over_sphere.toml --set cloth.sheet.shape.counts=[65,65] --substeps 10
    pipeline live dam.toml --preview --port 0
    """
    from pipeline.job.checks import load_checked_job
    from pipeline.job.loading import read_job
    from pipeline.live.frame_watch import PATIENCE_S
    from pipeline.live.knobs import knobs_of
    from pipeline.live.pace import fluent, told_pace
    from pipeline.live.scene import computing_power, live_job, require_small
    from pipeline.resources import machine_capacity
    from pipeline.view.serving import require_viser
    from sim.runtime import resolve_device

    if as_written and substeps is not None:
        raise click.UsageError("--as-written keeps the job's substeps, and --substeps changes them; give one of them")
    require_viser()
    loaded = read_job(job_file, overrides, preview=preview)
    require_own_programs(loaded, overrides)
    job = live_job(loaded.job, substeps=substeps)
    loaded, findings = load_checked_job(job_file, overrides, preview=preview)
    threads, on_gpu = cores or machine_capacity().cores, resolve_device(job.device) != "cpu"
    if not as_written and substeps is None:
        job = fluent(job, power=computing_power(cores=threads, on_gpu=on_gpu))
    if not anyway:
        require_small(job, findings.particles, cores=threads, on_gpu=on_gpu)
    print_warnings(loaded.warnings)
    if pace := told_pace(loaded.job, {knob.name: knob.start for knob in knobs_of(job)}):
        click.echo(pace)

    from pipeline.live.running import Address, show_live

    with told_to_stop() as stop:
        show_live(
            loaded,
            job,
            Address(host, port),
            gave_up=bool(pace) and substeps is None,
            patience_s=math.inf if anyway else PATIENCE_S,
            output=output,
            folder=Path.cwd(),
            threads=cores,
            paused=paused,
            say=lambda address: click.echo(f"{address} runs {job.name}; Ctrl-C ends it"),
            tell=click.echo,
            ends=stop.is_set,
        )
