"""Commands that show a job's frames in a browser: view."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.commands.arguments import find_job, parse_size, submitted_job_argument
from pipeline.commands.stopping import told_to_stop


@click.command()
@submitted_job_argument
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="0 takes a free one.")
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address of this machine alone; from others, ssh -L."
)
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
    from pipeline.view.serving import require_viser

    layout = find_job(job, output)
    require_viser()
    from pipeline.view.page import show_job

    with told_to_stop() as stop:
        show_job(
            layout,
            host=host,
            port=port,
            most_particles=particles,
            most_bytes=memory,
            say=lambda address: click.echo(f"{address} shows {layout.root}; Ctrl-C ends it"),
            stop=stop,
        )
