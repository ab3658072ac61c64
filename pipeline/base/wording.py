"""Times, sizes and common phrases, as people read them."""

import unicodedata
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import click

LONGEST_LINE = 2000
_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of what steers a terminal or hides in a text: control, format, surrogate, separators."""


def duration(seconds: float) -> str:
    """A time span, to two figures or so: `4.1 s`, `42 s`, `5 min 3 s`, `2 h 10 min`."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def rough_duration(seconds: float) -> str:
    """A time span that is an estimate, to a figure or two: `40 s`, `9 min`, `4 h`, `12 days`."""
    if seconds > 100 * 365.0 * 86400.0:
        return "more than a century"
    for unit, length, least in (("days", 86400.0, 2.0), ("h", 3600.0, 1.8), ("min", 60.0, 1.5)):
        if seconds >= least * length:
            number = seconds / length
            return f"{number:.1f} {unit}" if number < 3.0 and unit != "min" else f"{number:,.0f} {unit}"
    return f"{max(5, 5 * round(seconds / 5)):.0f} s" if seconds >= 10.0 else f"{max(1.0, seconds):.0f} s"


def size(byte_count: float) -> str:
    """A file size: `512 bytes`, `3.4 KiB`, `1.9 GiB`."""
    if byte_count < 1024:
        return f"{byte_count:.0f} bytes"
    for unit in ("KiB", "MiB"):
        byte_count /= 1024
        if byte_count < 1024:
            return f"{byte_count:.1f} {unit}"
    return f"{byte_count / 1024:.1f} GiB"


def counted(number: int, noun: str) -> str:
    """A number of things: `1 file`, `12 files`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def moment(time_s: float) -> str:
    """A wall time [s since the epoch] in this machine's time zone."""
    return datetime.fromtimestamp(time_s, UTC).astimezone().strftime("%Y-%m-%d %H:%M:%S")


def mixed_devices(drawn_on: Mapping[str, int]) -> list[str]:
    """A warning of a film that was drawn by several kinds of device (frames by device); empty for one that was not."""
    if len(drawn_on) < 2:
        return []
    counts = ", ".join(f"{frames} on {device}" for device, frames in drawn_on.items())
    return [
        f"the film's frames were drawn by devices that round differently: {counts}; pipeline explain tells about each "
        "frame, pipeline rerun --stage render draws them anew"
    ]


def printable(text: str) -> str:
    """A line for a terminal, of whatever somebody wrote: control characters as escapes, and not endless."""
    shown = text if len(text) <= LONGEST_LINE else f"{text[:LONGEST_LINE]}..."
    return "".join(
        each.encode("unicode_escape").decode() if unicodedata.category(each) in _UNSEEN else each for each in shown
    )


def print_warnings(warnings: Sequence[str]) -> None:
    """Warnings go to the error stream, so that output stays fit for a pipe."""
    for warning in warnings:
        click.secho(f"warning: {printable(warning)}", err=True, fg="yellow")
