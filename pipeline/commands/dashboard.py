"""The command that shows a farm in a browser: dashboard."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import click

from pipeline.commands.arguments import output_option
from pipeline.errors import PipelineError

PORT = 8790


@click.command()
@output_option
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; others need a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="0: any free one.")
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File with the token that a browser has to show once; one is made up and printed if omitted.",
)
def dashboard(output: Path, host: str, port: int, token_file: Path | None) -> None:
    """Show the farm in a browser: jobs, frames as they arrive, the film so far, logs; pause, resume, cancel, retry.

    Only this machine can reach it, unless --host names another address; a browser then has to show a token once, which
    is part of the address that is printed. Ctrl-C ends the page, not the jobs.

    \b
    pipeline dashboard
    pipeline dashboard --output /data/renders --port 0
    pipeline dashboard --host studio-3 --token-file ~/.farm-token
    ssh -L 8790:127.0.0.1:8790 studio-3      from elsewhere, without another address and without a token
    """
    missing = [name for name in ("starlette", "uvicorn", "jinja2") if find_spec(name) is None]
    if missing:
        raise PipelineError(
            f"the dashboard needs {', '.join(missing)}: install the extra \"view\" (pip install '.[view]'), "
            "or use ./run, which has it"
        )
    from pipeline.dashboard.access import access_of
    from pipeline.dashboard.app import Dashboard
    from pipeline.dashboard.serving import address_of, listen, remark_of, serve

    if not output.is_dir():
        raise PipelineError(f"there is no folder {output}; name the one that holds the jobs' folders with --output")
    listening = listen(host, port)
    access = access_of(host, listening.getsockname()[1], token_file)
    address = address_of(listening, host)
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
