"""Commands that open a page in a browser: view, live, dashboard."""

import math
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from pipeline.base.errors import PipelineError, StageUnavailableError
from pipeline.base.wording import print_warnings
from pipeline.cli.arguments import (
    cores_option,
    find_job,
    job_options,
    output_option,
    parse_size,
    submitted_job_argument,
)

PACKAGES = ("viser", "starlette", "uvicorn", "jinja2")  # of the extra "view"


def host_option(meaning: str = "Address of this machine alone; from others, ssh -L.") -> Callable[[Any], Any]:
    """Address that the page is at."""
    return click.option("--host", default="127.0.0.1", show_default=True, help=meaning)


def port_option(port: int) -> Callable[[Any], Any]:
    """Port that the page is at."""
    of_port = click.IntRange(0, 65535)
    return click.option("--port", type=of_port, default=port, show_default=True, help="0 takes a free one.")


def require_pages() -> None:
    """Check that the packages for pages are there. Raises StageUnavailableError: one is not."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise StageUnavailableError(
            f"pages in a browser need {', '.join(missing)}: install the extra \"view\" (pip install '.[view]'), "
            "or use ./run, which has it"
        )


@click.command(short_help="Look at simulated frames in a browser: scrub, play, turn, colour.")
@submitted_job_argument
@port_option(8080)
@host_option()
@click.option(
    "--particles", type=click.IntRange(min=1), default=200_000, show_default=True, help="Most drawn of each fluid."
)
@click.option("--memory", callback=parse_size, default="1GB", show_default=True, help="Most that kept frames may take.")
def view(job: str, *, output: Path, port: int, host: str, particles: int, memory: int) -> None:
    """Look at a job's simulated frames in a browser: scrub, play, turn, colour; with the solvers' numbers.

    Works while the job runs, and changes nothing of it: new frames appear on the slider. Ends with Ctrl-C.

    \b
    pipeline view quickstart
    pipeline view renders/dam_break --port 0 --particles 1000000
    """
    layout = find_job(job, output)
    require_pages()
    from pipeline.web.serving import address, page_server, stop_event
    from pipeline.web.viewer.page import ViewPage

    with stop_event() as stop, page_server(host=host, port=port, label="pipeline view") as server:
        page = ViewPage(server, layout, most_particles=particles, most_bytes=memory)
        click.echo(f"{address(server)} shows {layout.root}; Ctrl-C ends it")
        page.run(stop)


@click.command(short_help="Play with a scene in a browser while it is computed.")
@job_options
@output_option
@port_option(8080)
@host_option()
@click.option("--substeps", type=click.IntRange(1, 200), help="Steps a frame of cloth: fewer are faster and softer.")
@click.option("--as-written", is_flag=True, help="Keep the job's substeps and self-collisions, however slow.")
@cores_option
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
    from pipeline.run.checked_job import checked, read_own_job
    from pipeline.web.live.admission import computing_power, fluent, live_job, require_small, told_changes
    from pipeline.web.live.parameters import parameters_of
    from pipeline.web.live.soundness import LONGEST_FRAME_S
    from sim.core.runtime import resolve_device

    if as_written and substeps is not None:
        raise click.UsageError("--as-written keeps the job's substeps, and --substeps changes them; give one of them")
    require_pages()
    loaded = read_own_job(job_file, overrides, preview=preview)
    job = live_job(loaded.job, substeps=substeps)
    loaded, findings = checked(loaded)
    threads, on_gpu = cores or machine_capacity().cores, resolve_device(job.chosen_device) != "cpu"
    if not as_written and substeps is None:
        job = fluent(job, power=computing_power(cores=threads, on_gpu=on_gpu))
    if not anyway:
        require_small(job, findings.elements["fluid"], findings.elements["soft"], cores=threads, on_gpu=on_gpu)
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


@click.command(short_help="Show all jobs in a browser, and control them there.")
@output_option
@port_option(8790)
@host_option("Address to listen on; others need a token.")
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File with the token that a browser has to show once; one is drawn and printed if omitted.",
)
def dashboard(output: Path, host: str, port: int, token_file: Path | None) -> None:
    """Show the farm in a browser: jobs, frames as they arrive, the film so far, logs; pause, resume, cancel, retry.

    Only this machine can reach it, unless --host names another address; a browser then has to show a token once, which
    is part of the address that is printed. Ctrl-C ends the page, not the jobs.

    \b
    pipeline dashboard
    pipeline dashboard --farm /data/renders --port 0
    pipeline dashboard --host studio-3 --token-file ~/.farm-token
    ssh -L 8790:127.0.0.1:8790 studio-3      from elsewhere, without another address and without a token
    """
    require_pages()
    from pipeline.web.auth import access_of
    from pipeline.web.dashboard.app import Dashboard
    from pipeline.web.serving import listen, remark_of, serve, url

    if not output.is_dir():
        raise PipelineError(f"there is no folder {output}; name the one that holds the jobs' folders with --farm")
    listening = listen(host, port)
    port = listening.getsockname()[1]
    access = access_of(host, port, token_file)
    address = url(host, port)
    if access.token is not None and token_file is None:
        address += f"?token={access.token}"

    def say() -> None:
        click.echo(address)
        if remark := remark_of(listening, host):
            click.echo(remark, err=True)
        if token_file is not None:
            click.echo(f"it asks for the token in {token_file}", err=True)
        click.echo("Ctrl-C ends the page; the jobs go on", err=True)

    serve(Dashboard(output, access).application(), listening, say)
    click.echo("the page is closed; the jobs go on", err=True)
