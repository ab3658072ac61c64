"""Errors of the renderer's files. Each survives pickling, and its text is fit for the user."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InvalidFileError(Exception):
    """A file is not what its format promises: truncated, not decodable, or wrong in content.

    Attributes:
        path: the file.
        reason: what is wrong with it.
    """

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path, self.reason = path, reason

    def __str__(self) -> str:
        return f"{self.path}: {self.reason}"


@contextmanager
def invalid_if_refused(path: Path) -> Iterator[None]:
    """A ValueError about a file's content as an InvalidFileError."""
    try:
        yield
    except ValueError as error:
        raise InvalidFileError(path, str(error)) from error


class VolumeUnavailableError(Exception):
    """OpenVDB cannot be loaded on this machine; says why and how to get it."""
