"""Whether the parts of a job's folder lie in it, and are files and folders where they should be.

A folder may come from somebody else, or have been mended by hand. What is behind a link is not the job's: nothing is
written, touched or removed there.
"""

import os
import stat
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath

_MOST_TOLD = 5


def is_inside(artifact: str) -> bool:
    """Whether a recorded path leads into the job's folder, by its text alone."""
    outside = artifact.startswith("/") or (".." in artifact and ".." in artifact.split("/"))
    return bool(artifact) and not outside and "\0" not in artifact


def check_places(layout: JobLayout, artifacts: Iterable[ArtifactPath] = ()) -> None:
    """Make sure that the job's own files, and these artifacts, are or can be files in the folder, behind no link.

    Raises PipelineError: something else is in the place of one; says what, and how to heal it.
    """
    files = [
        layout.job_file,
        layout.goal,
        layout.siblings,
        layout.recording_story,
        layout.manifest,
        layout.lease,
        layout.report,
    ]
    folders = [layout.receipts, layout.job_text("").parent, layout.parameters_text("").parent, layout.logs_folder]
    folders += [layout.preview_scratch, layout.stills, layout.inputs, layout.checkpoints]
    folders += [layout.rejected_picture(0).parent]
    by_folder: dict[str, set[str]] = defaultdict(set)
    for artifact in artifacts:
        folder, _, name = artifact.rpartition("/")
        by_folder[folder].add(name)
    names = {layout.root / folder: own for folder, own in by_folder.items()}
    names |= {layout.receipts / folder: {f"{name}.json" for name in own} for folder, own in by_folder.items()}
    faults = list(_faults(layout.root, files, {*folders, *names} - {layout.root}, names))
    if faults:
        more = [f"and {len(faults) - _MOST_TOLD} more"] if len(faults) > _MOST_TOLD else []
        raise PipelineError("\n".join([*faults[:_MOST_TOLD], *more]))


def _faults(root: Path, files: Iterable[Path], folders: set[Path], names: dict[Path, set[str]]) -> Iterator[str]:
    above = {parent for folder in folders for parent in folder.parents if parent.is_relative_to(root)} - {root}
    wrong: set[Path] = set()
    for folder in sorted(folders | above):  # those above come first
        found = None if wrong.intersection(folder.parents) else _found(folder)
        if found is not None and found != "a folder":
            wrong.add(folder)
            yield _fault(folder, found, "a folder of its own")
    for file in files:
        found = _found(file)
        if found is not None and found != "a file":
            yield _fault(file, found, "a file")
    for folder in sorted(names):
        if folder in wrong or wrong.intersection(folder.parents) or not folder.is_dir():
            continue
        with os.scandir(folder) as entries:
            odd = {entry.name for entry in entries if not entry.is_file(follow_symlinks=False)} & names[folder]
        for name in sorted(odd):
            yield _fault(folder / name, _found(folder / name) or "something", "a file")


def _fault(path: Path, found: str, wanted: str) -> str:
    return f"{path} is {found}, where the job must have {wanted}: move it away, and submit the job again"


def _found(path: Path) -> str | None:
    """What is at a path; None if there is nothing."""
    try:
        mode = path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    if stat.S_ISLNK(mode):
        return f"a link to {path.readlink()}"
    return "a folder" if stat.S_ISDIR(mode) else "a file" if stat.S_ISREG(mode) else "no file"
