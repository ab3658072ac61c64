"""The command that shows a farm in a browser: dashboard."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.base.errors import PipelineError
from pipeline.cli.arguments import output_option
from pipeline.cli.pages import address_options, require_pages

PORT = 8790


@click.command()
@output_option
@address_options(PORT, host_help="Address to listen on; others need a token.")
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
    pipeline dashboard --output /data/renders --port 0
    pipeline dashboard --host studio-3 --token-file ~/.farm-token
    ssh -L 8790:127.0.0.1:8790 studio-3      from elsewhere, without another address and without a token
    """
    require_pages()
    from pipeline.web.auth import access_of
    from pipeline.web.dashboard.app import Dashboard
    from pipeline.web.serving import listen, remark_of, serve, url

    if not output.is_dir():
        raise PipelineError(f"there is no folder {output}; name the one that holds the jobs' folders with --output")
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
