"""Progress of a run: live bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Self, TextIO

from rich import progress as bars
from rich.console import Console
from rich.text import Text

from pipeline.base import wording
from pipeline.base.task import ArtifactPath, TaskId, TaskState
from pipeline.run.events import Committed, Failed, Notice, Progress, RunEvent, RunStarted, StateChanged, Warned
from pipeline.run.plan import Assessment, Verdict, summarize

PLAIN_INTERVAL_S = 10.0
"""Between two lines about the same stage where there is no terminal."""


@dataclass
class StageProgress:
    """How far a stage is, counted in artifacts."""

    name: str
    total: int
    done: int
    failed: int = 0
    message: str = ""
    at_start: int = 0
    about: str = ""  # what it makes, in a few words
    began: float | None = None
    ended: float | None = None
    _preparing_since: float | None = None

    def prepare(self, now: float) -> None:
        """From now on [monotonic s] it does what is done once on a machine, which says nothing about its rate."""
        if self._preparing_since is None:
            self._preparing_since = now

    def end_preparing(self, now: float) -> None:
        """It goes on; what it prepared for does not count."""
        if self._preparing_since is not None and self.began is not None:
            self.began += now - max(self._preparing_since, self.began)
        self._preparing_since = None

    def advance(self, artifacts: int, now: float) -> None:
        """So many more are committed at monotonic time `now` [s]."""
        self.began = now if self.began is None else self.began
        self.done += artifacts
        if self.done >= self.total:
            self.ended = now

    def rate(self, now: float) -> float | None:
        """Artifacts a second of this run; None before there are three, as two may come at once."""
        if self.began is None or self._preparing_since is not None or self.done - self.at_start < 3:
            return None
        seconds = (self.ended or now) - self.began
        # The first one only starts the clock, as its beginning was not seen.
        return (self.done - self.at_start - 1) / seconds if seconds > 0 else None

    def remaining_s(self, now: float) -> float | None:
        """Estimated time until the last one [s]."""
        rate = self.rate(now)
        return (self.total - self.done) / rate if rate else None

    def describe(self, now: float) -> str:
        """Count, rate and what is left, in one phrase."""
        parts = [f"{self.done}/{self.total}"]
        rate, remaining = self.rate(now), self.remaining_s(now)
        if rate is not None:
            parts.append(f"{rate:.2f}/s" if rate >= 0.1 else f"{1.0 / rate:.1f} s each")
        if remaining:
            parts.append(f"{wording.duration(remaining)} left")
        if self.failed:
            parts.append(f"{self.failed} failed")
        return ", ".join(parts)


@dataclass
class ProgressObserver:
    """Turns a run's events into progress by stage. A context manager that closes its display."""

    display: Display
    about: Mapping[str, str] = field(default_factory=dict)  # what stages make, by their names
    stages: dict[str, StageProgress] = field(default_factory=dict)
    _awaited: dict[TaskId, set[ArtifactPath]] = field(default_factory=dict)
    _stage_of: dict[TaskId, str] = field(default_factory=dict)
    _said: set[tuple[str, str]] = field(default_factory=set)

    def notify(self, event: RunEvent) -> None:
        """Take note of an event, and show it."""
        now = time.monotonic()
        match event:
            case RunStarted(assessments):
                self._start(assessments)
            case Committed(task_id, _, receipt):
                self._count(task_id, {receipt.artifact}, now)
            case Progress(task_id, _, _, _, message, preparing):
                stage = self.stages[self._stage_of[task_id]]
                stage.message = message
                if preparing and message:  # it takes minutes, and nobody is to take it for a hang
                    stage.prepare(now)
                    self._say_once(stage.name, message, f"{stage.name}: {message}")
                elif not preparing:
                    stage.end_preparing(now)
            case StateChanged(task_id, _, TaskState.UP_TO_DATE | TaskState.SUCCEEDED):
                self._count(task_id, self._awaited[task_id], now)
            case StateChanged(task_id, stage, TaskState.FAILED):
                self.stages[stage].failed += 1
            case Failed(task_id, attempt, kind, message):
                self.display.say(f"{task_id} (attempt {attempt}) {kind.value}: {message}", style="red")
            case Warned(task_id, _, kind, message):
                sentence = f"warning: {message}; more are in the logs: pipeline explain --log"
                self._say_once(self._stage_of[task_id], kind, sentence, style="yellow")
            case Notice(message):
                self.display.say(message, style="yellow")
            case _:
                return
        self.display.show(self.stages.values())

    def _start(self, assessments: Sequence[Assessment]) -> None:
        # What a change concerns is said before it runs; that a new job has to run is no news.
        if any(assessment.verdict is Verdict.UP_TO_DATE for assessment in assessments):
            for line in summarize(each for each in assessments if each.verdict is not Verdict.UP_TO_DATE):
                self.display.say(line)
        for assessment in assessments:
            task = assessment.task
            done = len(task.outputs) - len(assessment.rebuilds)
            about = self.about.get(task.stage, "")
            stage = self.stages.setdefault(task.stage, StageProgress(task.stage, 0, 0, about=about))
            stage.total += len(task.outputs)
            stage.done += done
            stage.at_start += done
            self._stage_of[task.id] = task.stage
            self._awaited[task.id] = set(assessment.rebuilds)

    def _say_once(self, stage: str, kind: str, sentence: str, *, style: str = "") -> None:
        """The first of each kind: thousands of frames may lose their camera, or wait for the same kernels."""
        if (stage, kind) not in self._said:
            self._said.add((stage, kind))
            self.display.say(sentence, style=style)

    def _count(self, task_id: TaskId, artifacts: set[ArtifactPath], now: float) -> None:
        """These are there now; each counts once, also if a second attempt commits it again."""
        news = self._awaited[task_id] & artifacts
        if news:
            self._awaited[task_id] = self._awaited[task_id] - news
            self.stages[self._stage_of[task_id]].advance(len(news), now)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.display.close()


def remaining_of_all_s(stages: Iterable[StageProgress], now: float) -> float | None:
    """Estimated time until all stages are done [s], one after the other; None while a rate is not known."""
    left = [stage.remaining_s(now) for stage in stages if stage.done < stage.total]
    known = [each for each in left if each is not None]
    return sum(known) if known and len(known) == len(left) else None


class LiveDisplay:
    """A bar for the job `name` and one a stage, redrawn in place (rich)."""

    def __init__(self, console: Console, name: str) -> None:
        self._began = time.monotonic()
        self._name = name
        self._progress = bars.Progress(
            bars.TextColumn("{task.fields[name]:>9}"),
            bars.BarColumn(bar_width=30),
            bars.TextColumn("{task.fields[counts]}", style="cyan"),
            bars.TextColumn("{task.fields[message]}", style="dim"),
            console=console,
            refresh_per_second=8,
        )
        self._bars: dict[str, bars.TaskID] = {}
        self._progress.start()

    def show(self, stages: Iterable[StageProgress]) -> None:
        """Update the bars."""
        now, stages = time.monotonic(), list(stages)
        left = remaining_of_all_s(stages, now)
        times = f"{wording.duration(now - self._began)} so far"
        counts = times if left is None else f"{times}, about {wording.duration(left)} left"
        done, total = (sum(getattr(stage, key) for stage in stages) for key in ("done", "total"))
        if stages:
            self._update(self._name, done, total, counts)
        for stage in stages:
            message = "" if stage.done >= stage.total else stage.message or stage.about
            self._update(stage.name, stage.done, stage.total, stage.describe(now), message)

    def _update(self, name: str, done: int, total: int, counts: str, message: str = "") -> None:
        if name not in self._bars:
            self._bars[name] = self._progress.add_task(name, name=name, counts="", message="", total=total)
        self._progress.update(self._bars[name], completed=done, total=total, counts=counts, message=message)

    def say(self, sentence: str, *, style: str = "") -> None:
        """Print above the bars."""
        self._progress.console.print(Text(sentence, style=style))

    def close(self) -> None:
        """Draw the bars a last time and leave them standing."""
        self._progress.stop()


class PlainDisplay:
    """A line now and then, for logs and pipes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._began = time.monotonic()
        self._said: dict[str, tuple[float, int]] = {}
        self._explained: set[str] = set()

    def show(self, stages: Iterable[StageProgress]) -> None:
        """A line for each stage that moved, every so often, and for its end."""
        now = time.monotonic()
        for stage in stages:
            said, done = self._said.setdefault(stage.name, (now, stage.done))
            ended = stage.done >= stage.total
            if stage.done != done and (ended or now - said >= PLAIN_INTERVAL_S):
                self._said[stage.name] = (now, stage.done)
                about = f" ({stage.about})" if stage.about and stage.name not in self._explained else ""
                self._explained.add(stage.name)
                self.say(f"{stage.name}{about} {stage.describe(now)}")

    def say(self, sentence: str, *, style: str = "") -> None:  # noqa: ARG002 - colours are for terminals
        """Print with the time since the start. Nobody listening any more (`| head`) is no reason to end the run."""
        with suppress(BrokenPipeError):
            print(f"[{time.monotonic() - self._began:8.1f} s] {sentence}", file=self._stream, flush=True)

    def close(self) -> None:
        """Nothing to tidy up."""


Display = LiveDisplay | PlainDisplay


def open_display(name: str) -> Display:
    """Display of the job `name`: live bars if standard error is a terminal, else plain lines."""
    console = Console(stderr=True)
    return LiveDisplay(console, name) if console.is_terminal else PlainDisplay(sys.stderr)
