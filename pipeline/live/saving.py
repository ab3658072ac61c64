"""The job with the values that were found by playing, as a job file beside the old one's remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.files import replace_durably
from pipeline.job.loading import changed_text, job_of_text
from pipeline.job.overrides import Override
from pipeline.live.knobs import Value, knobs_of, overrides_of

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob


def text_with_values(loaded: LoadedJob, values: Mapping[str, Value], changes: Sequence[Override] = ()) -> str:
    """The job's text with what differs from it: remarks, order and all other keys stay.

    Args:
        loaded: the job that is played with, as it was read.
        values: of its knobs, by name.
        changes: further ones.

    Raises:
        JobFileError: the values make no job.
    """
    text = changed_text(loaded.text, [*overrides_of(knobs_of(loaded.job), values), *changes])
    job_of_text(text, loaded.path)
    return text


def save_job(loaded: LoadedJob, values: Mapping[str, Value], folder: Path) -> Path:
    """Write the job into a new file NAME-live.toml, NAME-live-2.toml, ... of the same name; returns its path.

    Raises:
        JobFileError: the values make no job.
        OSError: it cannot be written.
    """
    path = next(path for path in _names(folder, f"{loaded.job.name}-live", ".toml") if not path.exists())
    replace_durably(path, text_with_values(loaded, values, [Override(("name",), path.stem, "live")]))
    return path


def _names(folder: Path, stem: str, suffix: str) -> Iterator[Path]:
    yield folder / f"{stem}{suffix}"
    for number in count(2):
        yield folder / f"{stem}-{number}{suffix}"
