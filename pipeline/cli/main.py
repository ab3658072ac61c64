"""The command line: parse, call, print. Importing this module loads neither the physics nor Blender."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click

from pipeline import __version__
from pipeline.base.errors import PLACE_TROUBLES, DiskFullError, PipelineError
from pipeline.base.wording import printable
from pipeline.cli.control import cancel, pause, priority, resume, work
from pipeline.cli.export import export
from pipeline.cli.keep import clean, doctor, schema, verify
from pipeline.cli.look import explain, status
from pipeline.cli.make import check, new, plan, rerun, submit
from pipeline.cli.pages import dashboard, live, view
from pipeline.cli.pictures import animatic, compare, loop, report, still
from pipeline.cli.sweep import sweep
from pipeline.run.executors.failures import is_disk_full

SECTIONS = {
    "Make a film": (new, check, plan, submit, sweep, rerun, export),
    "Look at it": (status, explain, view, live, still, animatic, compare, loop, report, dashboard),
    "Control jobs that run or wait": (pause, resume, cancel, priority, work),
    "Keep things in order": (verify, clean, doctor, schema),
}

FORMER = {
    "queue": "pipeline status",
    "watch": "pipeline status --follow my-film",
    "logs": "pipeline explain --log my-film [TASK]",
    "retry": "pipeline rerun --failed my-film",
    "run-stage": "pipeline work my-film --stage STAGE",
    "sheet": "pipeline still --sheet my-film",
}
"""What to type instead of a command that there was once."""

FORMER_OPTIONS = {
    "--output": "the farm, the folder of the jobs' folders, is --farm",
    "--to": "where a result goes is -o",
}
"""What to type instead of an option that there was once."""


class UnknownCommandError(PipelineError):
    """A word in place of a command is none; says what to type instead."""

    exit_code = 2


class PipelineGroup(click.Group):
    """A group of commands in sections, whose errors are lines for people and no tracebacks."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a `PipelineError` decides the exit code."""
        try:
            return super().invoke(ctx)
        except click.NoSuchOption as error:
            if error.option_name not in FORMER_OPTIONS:
                raise
            message = f"no such option {error.option_name}: {FORMER_OPTIONS[error.option_name]}"
            raise click.UsageError(message, error.ctx) from error
        except PipelineError as error:
            for line in str(error).split("\n"):
                click.secho(f"error: {printable(line)}", err=True, fg="red")
            ctx.exit(error.exit_code)
        except OSError as error:
            if error.errno not in PLACE_TROUBLES:
                raise
            place = f"{error.filename}: " if error.filename else ""
            click.secho(f"error: {place}{error.strerror}; what is finished stays: try again later", err=True, fg="red")
            ctx.exit(DiskFullError.exit_code if is_disk_full(error) else PipelineError.exit_code)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that is called. Raises UnknownCommandError if there is none."""
        name = args[0]
        if name not in self.commands and not name.startswith("-"):
            raise UnknownCommandError(_meant(name, args[1:], [*self.commands]))
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Every command with its whole summary, section by section."""
        width = max(map(len, self.commands), default=0)
        for heading, commands in SECTIONS.items():
            rows = [(f"{each.name:<{width}}", each.get_short_help_str(limit=1000)) for each in commands]
            with formatter.section(heading):
                formatter.write_dl(rows)


def _meant(name: str, rest: list[str], commands: list[str]) -> str:
    """A sentence about a word in place of a command."""
    if name in FORMER:
        words = [each for each in rest if not each.startswith("-")]
        film = words[0] if words else "my-film"
        return f"{name} is now: {FORMER[name].replace('my-film', film)}"
    for file in (name, f"{name}.toml"):
        if Path(file).is_file() or Path(name).suffix == ".toml":
            return f"{file} is a job file; did you mean: pipeline submit {name}"
    typed = {command: f"pipeline {command}" for command in commands} | FORMER
    near = get_close_matches(name, typed, n=1)
    return f'no command "{name}"; ' + (f"did you mean: {typed[near[0]]}" if near else "see: pipeline --help")


@click.group(
    cls=PipelineGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Start with: pipeline new my-film, then: pipeline submit my-film",
)
@click.version_option(package_name=None, version=__version__, prog_name="pipeline")
def main() -> None:
    """From a job file to a film of simulated physics, resumable after any crash."""


for section in SECTIONS.values():
    for command in section:
        main.add_command(command)
