"""Printing for people."""

from __future__ import annotations

from collections.abc import Sequence

import click


def print_warnings(warnings: Sequence[str]) -> None:
    """Warnings go to the error stream, so that output stays fit for a pipe."""
    for warning in warnings:
        click.secho(f"warning: {warning}", err=True, fg="yellow")
