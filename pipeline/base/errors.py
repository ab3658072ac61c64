"""Errors of the orchestrator. Each survives pickling, and its text is fit for the user."""

import errno
from pathlib import Path
from typing import Self

PLACE_TROUBLES = frozenset(
    {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.ENODEV}
    | {errno.ENXIO, errno.ENOTCONN, errno.ETIMEDOUT}
)
"""Codes of an OSError that are about a disk, a mount or permissions, and no fault of this program."""


NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP})
"""Codes of an OSError of `flock` where a file system has no locks."""


class PipelineError(Exception):
    """Base of everything that ends a command, with an exit code, with a clear line instead of a traceback."""

    exit_code = 1


class JobFileError(PipelineError):
    """The job file is wrong; carries every problem found, one line each."""

    exit_code = 2

    def __init__(self, problems: list[str]) -> None:
        super().__init__(problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


class StageUnavailableError(PipelineError):
    """A stage cannot run on this machine; says what is missing and how to get it."""

    exit_code = 3


class MissingInputError(PipelineError):
    """A file of the user's that the job is made from is not there, or cannot be read."""

    exit_code = 2


class InvalidArtifactError(PipelineError):
    """A file is not what its stage promises: truncated, not decodable, or wrong in content."""


class StaleAttemptError(PipelineError):
    """A newer attempt of the same task has committed already; this one must not write."""


class DiskFullError(PipelineError):
    """There is no room for what a command has to write."""

    exit_code = 7

    @classmethod
    def of(cls, folder: Path) -> Self:
        """The disk of this folder is full."""
        return cls(f"the disk is full ({folder}); free some space and submit the job again")


class JobBusyError(PipelineError):
    """Another live process is running this job."""

    exit_code = 4


class LeaseLostError(PipelineError):
    """Another process has taken this job over; this one must stop writing its record."""

    exit_code = 4


class FolderGoneError(PipelineError):
    """The job's folder is not where it was any more; nothing is made in its place."""

    @classmethod
    def of(cls, folder: Path) -> Self:
        """This folder was there when the command began."""
        return cls(f"{folder} is not there any more; if it was renamed, resume the job by its new name")


class ManifestError(PipelineError):
    """The job's manifest cannot be used; says how to get a good one from the receipts."""


class DamagedManifestError(ManifestError):
    """The manifest's file is damaged; the next run of the job makes it anew of the receipts."""


class OutdatedManifestError(ManifestError):
    """The manifest is of an older program, or was not finished; the next run of the job brings it up to date."""


class PlanError(PipelineError):
    """The stages' tasks do not fit together: an artifact without a maker, or with two, or a circle."""
