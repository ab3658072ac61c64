"""Recordings of `pipeline live` whose recorder was killed: their frames make the film all the same.

Only the end of a recording writes `frames` into its job; until then the job has one, and the recording's story none.
"""

import json
from typing import Any, NamedTuple, TypeGuard

from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.wording import counted
from pipeline.job.loading import changed_text, read_job
from pipeline.job.overrides import Override
from pipeline.record.manifest import Manifest
from pipeline.record.reconcile import reconcile
from pipeline.store.receipts import read_receipt, verify_artifact


class FoundFrames(NamedTuple):
    """Frames of a recording whose job does not know of them."""

    whole: int  # how many are there, from the first on
    behind: int  # how many lie behind the first one that is missing or damaged, that one not counted
    is_cut: bool  # whether one is missing or damaged, and not just the end

    @property
    def flaw(self) -> str:
        """Fault of the frames behind those that count, a sentence; "" if there are none."""
        if not self.is_cut:
            return ""
        more = f"; {self.behind} more {'lies' if self.behind == 1 else 'lie'} behind it" if self.behind else ""
        return f"frame {self.whole} is missing or damaged{more}"


def frames_of_interrupted_recording(layout: JobLayout) -> FoundFrames | None:
    """Frames of a recording whose job does not know of them; None if there is no such recording.

    One that is being recorded looks the same: its folder is held.
    """
    if (story := _story(layout)) is None or story["frames"] is not None:
        return None
    frames, fingerprint = 0, None
    while (receipt := read_receipt(layout, layout.frame_cache(frames))) is not None:
        if receipt.fingerprint != (fingerprint or receipt.fingerprint) or verify_artifact(layout, receipt) is not None:
            break
        frames, fingerprint = frames + 1, receipt.fingerprint
    folder = layout.receipt(layout.frame_cache(0)).parent
    receipts = [int(path.name.partition(".")[0]) for path in folder.glob(f"{'[0-9]' * 6}.h5.json")]
    return FoundFrames(
        frames, sum(number > frames for number in receipts), any(number >= frames for number in receipts)
    )


def is_job_of_recording(layout: JobLayout) -> bool:
    """Whether the job in a recording's folder is the recording's; any other simulates, over its frames.

    An illegible story names no recording. Raises JobFileError if the job file is damaged.
    """
    story = _story(layout)
    recorded = read_job(layout.job_file).job.recorded
    return recorded is not None and (story is None or recorded == story["take"])


def complete_interrupted_recording(layout: JobLayout) -> str:
    """Write into a recording's job and story how many frames it has, if its recorder could not.

    A job that somebody has given another length meanwhile keeps it. Where a frame is missing or damaged and others lie
    behind it, the story stays open: should that frame come back, the next call takes over the rest.

    Returns:
        What was done, a sentence; "" if there was nothing to do.

    Raises:
        JobBusyError: it is being recorded.
        JobFileError: its job file is damaged.
        OSError: the folder cannot be read or written.
    """
    if not _has_any(frames_of_interrupted_recording(layout)):
        return ""
    with Lease.acquire(layout.lease):
        found, story = frames_of_interrupted_recording(layout), _story(layout)
        if not _has_any(found) or story is None:  # another process was faster
            return ""
        loaded = read_job(layout.job_file)
        job = loaded.job
        if job.recorded != story["take"]:  # somebody has put another job into the folder
            return ""
        told = f"the recording of {job.name} was cut short: "
        if not found.whole:
            return f"{told}{found.flaw}"
        if job.frame_count == story.get("taken_over", 1):
            length = ("duration", found.whole / job.fps) if job.duration is not None else ("frames", found.whole)
            replace_durably(layout.job_file, changed_text(loaded.text, [Override((length[0],), length[1], "take")]))
        story["frames" if not found.is_cut else "taken_over"] = found.whole
        replace_durably(layout.recording_story, json.dumps(story, indent=2, ensure_ascii=False) + "\n")
        with Manifest(layout.manifest) as manifest:
            reconcile(manifest, layout, clean=False)
    frames = counted(found.whole, "frame")
    return f"{told}it has {frames}, and so has its job file now{f'; {found.flaw}' if found.is_cut else ''}"


def _has_any(found: FoundFrames | None) -> TypeGuard[FoundFrames]:
    """Whether there is a frame, whole or not."""
    return found is not None and (found.whole > 0 or found.is_cut)


def _story(layout: JobLayout) -> dict[str, Any] | None:
    """The recording's story; None if the folder holds no recording, or the story is illegible."""
    try:
        story = json.loads(layout.recording_story.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return story if isinstance(story, dict) and "take" in story and "frames" in story else None
