"""Observers of a run: the progress display, the log, `--json`."""

from __future__ import annotations

from typing import Protocol

from pipeline.run.events import RunEvent


class Observer(Protocol):
    """Watches a run. Called from the run's own loop, so it should be quick, and must not raise."""

    def notify(self, event: RunEvent) -> None:
        """Something happened."""


class Observers:
    """Several observers; each gets every event, in order."""

    def __init__(self, *observers: Observer) -> None:
        self._observers = observers

    def notify(self, event: RunEvent) -> None:
        """Pass the event on."""
        for observer in self._observers:
            observer.notify(event)


class SilentObserver:
    """Watches and does nothing."""

    def notify(self, event: RunEvent) -> None:
        """Ignore the event."""
