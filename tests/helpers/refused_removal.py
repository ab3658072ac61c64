"""Folders that may not be removed, also for root."""

import errno
import os
from pathlib import Path

import pytest


def refuse_removal(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Have nothing removed in a folder by this process, as where its files are another user's."""

    def refuse(name: str) -> None:
        does = getattr(os, name)

        def asked(path: str | bytes | Path, *arguments: object, **options: object) -> object:
            if Path(os.fsdecode(path)).is_relative_to(folder):
                raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), path)
            return does(path, *arguments, **options)

        monkeypatch.setattr(os, name, asked)

    for name in ("lstat", "chmod"):  # what a removal begins with, and what Python tries where that is refused
        refuse(name)
