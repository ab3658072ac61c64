"""Commands that show a job's frames in a browser: view."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.cli.arguments import find_job, parse_size, submitted_job_argument
from pipeline.cli.pages import address_options, require_pages


@click.command()
@submitted_job_argument
@address_options(8080)
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
