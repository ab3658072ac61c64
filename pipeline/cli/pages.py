"""Options and requirements that commands with a page in a browser share."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import click

from pipeline.base.errors import StageUnavailableError

PACKAGES = ("viser", "starlette", "uvicorn", "jinja2")
"""Of the extra "view"."""


def address_options(
    port: int, *, host_help: str = "Address of this machine alone; from others, ssh -L."
) -> Callable[[Any], Any]:
    """Where the page is: `--host` and `--port`."""

    def decorate(command: Any) -> Any:
        of_port = click.IntRange(0, 65535)
        for option in (
            click.option("--host", default="127.0.0.1", show_default=True, help=host_help),
            click.option("--port", type=of_port, default=port, show_default=True, help="0 takes a free one."),
        ):
            command = option(command)
        return command

    return decorate


def require_pages() -> None:
    """Check that the packages for pages are there.

    Raises:
        StageUnavailableError: one is not.
    """
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise StageUnavailableError(
            f"pages in a browser need {', '.join(missing)}: install the extra \"view\" (pip install '.[view]'), "
            "or use ./run, which has it"
        )
