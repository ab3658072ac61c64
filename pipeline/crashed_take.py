"""Takes whose recorder ended without writing how many frames there are: their frames make the film all the same.

Only the end of a take writes `frames` into its job; until then the job has one, and the take's story has none.
"""

from __future__ import annotations

import json
from itertools import count
from typing import Any

from pipeline.files import replace_durably
from pipeline.job.loading import changed_text, read_job
from pipeline.job.overrides import Override
from pipeline.layout import JobLayout
from pipeline.lease import Lease
from pipeline.manifest import Manifest
from pipeline.receipts import read_receipt, verify_artifact
from pipeline.reconcile import reconcile


def frames_of_crashed_take(layout: JobLayout) -> int | None:
    """How many frames, from the first on, a take has whose job does not know of them; None if there is no such take.

    One that is being recorded looks the same: its folder is held.

    Args:
        layout: of any folder.
    """
    if (story := _story(layout)) is None or story["frames"] is not None:
        return None
    fingerprint = None
    for frame in count():
        receipt = read_receipt(layout, layout.frame_cache(frame))
        if receipt is None or receipt.fingerprint != (fingerprint or receipt.fingerprint):
            return frame
        if verify_artifact(layout, receipt) is not None:
            return frame
        fingerprint = receipt.fingerprint
    raise AssertionError("numbers do not end")


def complete_crashed_take(layout: JobLayout) -> str:
    """Write into a take's job and story how many frames it has, if its recorder could not.

    A job that somebody has given another length meanwhile keeps it.

    Args:
        layout: of any folder.

    Returns:
        What was done, a sentence; "" if there was nothing to do.

    Raises:
        JobBusyError: the take is being recorded.
        JobFileError: its job file is damaged.
        OSError: the folder cannot be read or written.
    """
    if not frames_of_crashed_take(layout):
        return ""
    with Lease.acquire(layout.lease):
        frames, story = frames_of_crashed_take(layout), _story(layout)
        if not frames or story is None:  # another process was faster
            return ""
        loaded = read_job(layout.job_file)
        job = loaded.job
        if job.recorded != story["take"]:  # somebody has put another job into the folder
            return ""
        if job.frame_count == 1:
            length = ("duration", frames / job.fps) if job.duration is not None else ("frames", frames)
            replace_durably(layout.job_file, changed_text(loaded.text, [Override((length[0],), length[1], "take")]))
        story["frames"] = frames
        replace_durably(layout.take_story, json.dumps(story, indent=2, ensure_ascii=False) + "\n")
        with Manifest(layout.manifest) as manifest:
            reconcile(manifest, layout, clean=False)
    told = "1 frame" if frames == 1 else f"{frames} frames"
    return f"the recording of {job.name} was cut short: it has {told}, and so has its job file now"


def _story(layout: JobLayout) -> dict[str, Any] | None:
    """What is told of a take; None if the folder is that of no take, or nothing legible is told."""
    try:
        story = json.loads(layout.take_story.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return story if isinstance(story, dict) and "take" in story and "frames" in story else None
