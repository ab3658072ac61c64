"""In which order the frames of a job take their turns."""

from __future__ import annotations

from collections import deque

from pipeline.model.job import Job


def frame_turns(job: Job) -> list[int] | None:
    """The turn of each frame, 0 for the first; None: as in the film."""
    return spread_turns(job.frame_count) if job.render.order == "spread" else None


def spread_turns(frames: int) -> list[int]:
    """Turns of frames that are taken from all over the film: the first, the last, the middle, then between these.

    After any number of turns no gap is more than twice as long as another, give or take a frame.
    """
    turns = [0] * frames
    taken = 0
    for frame in dict.fromkeys((0, frames - 1)):
        turns[frame] = taken
        taken += 1
    gaps = deque([(0, frames - 1)])
    while gaps:
        before, after = gaps.popleft()
        if after - before < 2:
            continue
        middle = (before + after) // 2
        turns[middle] = taken
        taken += 1
        gaps += [(before, middle), (middle, after)]
    return turns
