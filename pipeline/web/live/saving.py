"""Saving: the job with its present values as a job file, with the remarks of the old one."""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

from pipeline.base.files import sync
from pipeline.base.layout import JobLayout
from pipeline.job.loading import LoadedJob, changed_text, job_of_text
from pipeline.job.overrides import Override, without_key
from pipeline.kinds.live_parameters import Value
from pipeline.web.live.parameters import overrides_of, parameters_of


def text_with_values(loaded: LoadedJob, values: Mapping[str, Value], changes: Sequence[Override] = ()) -> str:
    """The job's text with these values and changes: remarks, order and all other keys stay.

    Raises JobFileError: the values make no job.
    """
    text = changed_text(loaded.text, [*overrides_of(parameters_of(loaded.job), values), *changes])
    job_of_text(text, loaded.path)
    return text


def save_job(loaded: LoadedJob, values: Mapping[str, Value], folder: Path) -> tuple[Path, str]:
    """Write the job into a new file NAME-live.toml, NAME-live-2.toml, ... of the same name; with a remark, or "".

    Of a recording's job it becomes one that is simulated: without `recorded`, and bodies rest that rested before it.

    Raises:
        JobFileError: the values make no job.
        OSError: it cannot be written.
    """
    led = bodies_led_before(loaded)
    tables = dict.fromkeys(body.table for body in loaded.job.rigid if led is not None and body.name in led)
    at_rest = [Override(("rigid", table, "kind"), "static", "live") for table in tables]
    for path in numbered_paths(folder, f"{loaded.job.name}-live", ".toml"):
        text = text_with_values(loaded, values, [Override(("name",), path.stem, "live"), *at_rest])
        if loaded.job.recorded is not None:
            text = without_key(text, "recorded")
        try:
            file = path.open("x", encoding="utf-8")  # another session may write here as well
        except FileExistsError:
            continue
        try:
            with file:
                file.write(text)
            sync(path)
        except BaseException:
            path.unlink()
            raise
        story = JobLayout(loaded.path.parent).recording_story.name
        note = f"; {story} is not there, so bodies that rested before the recording may be kinematic in it"
        return path, (note if led is None and loaded.job.rigid else "")
    raise AssertionError("numbers do not end")


def bodies_led_before(loaded: LoadedJob) -> list[str] | None:
    """Bodies that are kinematic only because a recording, whose job this is, could lead them; None if nothing tells."""
    if loaded.job.recorded is None:
        return []
    try:
        story = json.loads(JobLayout(loaded.path.parent).recording_story.read_text(encoding="utf-8"))
        led = story["led"] if story["take"] == loaded.job.recorded else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return led if isinstance(led, list) else None


def numbered_paths(folder: Path, stem: str, suffix: str = "") -> Iterator[Path]:
    """STEM, STEM-2, STEM-3, ... without end; whoever makes one of them sees whether it is free."""
    yield folder / f"{stem}{suffix}"
    for number in count(2):
        yield folder / f"{stem}-{number}{suffix}"
