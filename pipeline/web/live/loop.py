"""The loop of `pipeline live`: requests, a frame, its picture, and the wait until the next is due."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from pipeline.run.executors.failures import describe, is_out_of_memory
from pipeline.web.live.session import Session

if TYPE_CHECKING:
    from pipeline.web.live.page import LivePage

SHOWN_EVERY_S = 1.0 / 30.0
"""Least time between two pictures of a page, on average."""
TOLD_EVERY_S = 0.2
LONGEST_WAIT_S = 0.05
"""Longest wait for requests and the end, while time stands still or is slow."""


def run(session: Session, page: LivePage, *, ends: Callable[[], bool]) -> None:
    """Run a session until it `ends`: in real time, or as fast as it gets where that is slower.

    Lost time is not made up for: after a slow frame the next is due at once, and no earlier ones are owed. Where there
    is no memory to meet a request or to show the scene, the scene goes back; a second time, before the page was told,
    that would help no more.

    Raises:
        CannotGoOnError: there is no memory for the scene.
        MemoryError, RuntimeError: there is none for the page, or what was asked for, either.
    """
    due = show_due = told_at = time.perf_counter()
    shown, was_told, trouble = (-1, -1), True, ""
    while not ends():
        if trouble:  # not within the handler: an error's traceback would keep the old scene
            session.free_memory(trouble)
            was_told, trouble = False, ""
        try:
            now = time.perf_counter()
            session.meet_requests(0.0 if not session.is_paused and now >= due else _wait(session, now, due))
            now = time.perf_counter()
            if not session.is_paused and now >= due:
                session.advance()
                due = max(due + session.dt / session.speed, time.perf_counter())
            now = time.perf_counter()
            moment = (session.revision, session.world.frame)
            if moment != shown and now >= show_due:
                page.show()
                # Not so long after this: of frames that take two thirds of that time, only every other would be seen.
                shown, show_due = moment, max(show_due + SHOWN_EVERY_S, now)
            if now - told_at >= TOLD_EVERY_S:
                page.tell(session.status())
                told_at, was_told = now, True
        except (MemoryError, RuntimeError) as error:
            if not (was_told and is_out_of_memory(error)):
                raise
            trouble = describe(error)


def _wait(session: Session, now: float, due: float) -> float:
    return LONGEST_WAIT_S if session.is_paused else min(LONGEST_WAIT_S, max(due - now, 1e-4))
