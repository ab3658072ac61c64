"""Disks and folders that refuse: a line instead of a traceback, and nothing that keeps the next run out."""

import errno
import os
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from pipeline.base.lease import Lease
from pipeline.cli.main import PipelineGroup


def end_with(error: Exception) -> tuple[int, str, BaseException | None]:
    @click.group(cls=PipelineGroup)
    def program() -> None:
        pass

    @program.command()
    def write() -> None:
        raise error

    ended = CliRunner().invoke(program, ["write"])
    return ended.exit_code, ended.output, ended.exception


@pytest.mark.parametrize(
    ("number", "code"), [(errno.EROFS, 1), (errno.EACCES, 1), (errno.EIO, 1), (errno.ENOSPC, 7), (errno.EDQUOT, 7)]
)
def test_a_place_that_refuses_is_told_in_a_line(number: int, code: int) -> None:
    exit_code, output, exception = end_with(OSError(number, os.strerror(number), "renders/film/manifest.db"))
    assert isinstance(exception, SystemExit)
    assert (exit_code, output) == (
        code,
        f"error: renders/film/manifest.db: {os.strerror(number)}; what is finished stays: try again later\n",
    )


def test_a_fault_of_the_programs_own_keeps_its_traceback() -> None:
    assert isinstance(end_with(FileNotFoundError(errno.ENOENT, "absent", "x"))[2], FileNotFoundError)


def test_a_lease_that_cannot_be_given_back_hides_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    with pytest.raises(ValueError, match="the run's own"), Lease.acquire(tmp_path / "runner.lease"):
        monkeypatch.setattr(Path, "unlink", refuse)
        raise ValueError("the run's own")
    assert (tmp_path / "runner.lease").exists()
