"""Places that the dashboard may read: regular files in the folders of the farm's jobs, links resolved."""

from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.queue.job_queue import QueueError, checked_name


class NotThereError(PipelineError):
    """There is no such job, file or task, or it lies where the dashboard does not look."""


class Places:
    """Paths of jobs and files by their names, all within a farm: the folder of the jobs' folders, resolved."""

    def __init__(self, farm: Path) -> None:
        self.farm = farm.resolve()

    def job(self, name: str) -> Path:
        """The folder of a job. Raises NotThereError: there is none, or it is a link that leads out of the farm."""
        try:
            root = (self.farm / checked_name(name)).resolve()
        except (QueueError, OSError, RuntimeError) as error:  # a circle of links is a RuntimeError
            raise NotThereError(f"no job {name!a:.80}") from error
        if root.parent != self.farm:
            raise NotThereError("its folder is a link that leads out of the farm, where this page does not look")
        if not root.is_dir():
            raise NotThereError(f'there is no job "{name}" in this farm')
        return root

    def file(self, name: str, relative: str) -> Path:
        """A regular file of a job, by its path relative to the job's folder.

        Raises NotThereError: there is none, or it is a link that leads out of the job's folder.
        """
        root = self.job(name)
        try:
            path = (root / relative).resolve()
            if path.is_relative_to(root) and path.is_file():
                return path
        except (OSError, RuntimeError, ValueError) as error:  # ValueError: a NUL in it
            raise NotThereError(f"no such file in {name}") from error
        raise NotThereError(f"no such file in {name}")

    def has(self, name: str, relative: str) -> bool:
        """Whether a job has such a file."""
        try:
            self.file(name, relative)
        except NotThereError:
            return False
        return True

    def tail(self, name: str, relative: str, byte_count: int) -> tuple[str, int]:
        """The last bytes of a text file of a job, from a line's beginning on, and the size of all of it [bytes].

        Raises NotThereError: see `file`.
        """
        with self.file(name, relative).open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - byte_count))
            content = file.read(byte_count)
        if size > byte_count:
            content = content.partition(b"\n")[2] or content
        return content.decode("utf-8", errors="replace"), size


def printable(text: str) -> str:
    """A text that a page can hold: bytes of a file's name that are no UTF-8 are written out, as in `caf\\udce9`."""
    return text.encode(errors="backslashreplace").decode()
