"""The command line as a user calls it, in this process."""

from click.testing import CliRunner, Result

from pipeline.cli.main import main


def pipeline(*arguments: object) -> Result:
    """What a command printed and its exit code; an exception that it did not turn into a line is raised."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result
