"""Errors of the renderer's files. Each survives pickling, and its text is fit for the user."""

from __future__ import annotations

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


class VolumeUnavailableError(Exception):
    """OpenVDB cannot be loaded on this machine; says why and how to get it."""
