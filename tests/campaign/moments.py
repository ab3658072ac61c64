"""When a fault strikes: after a random time, at a transition of a task, or right before a step of a process."""

import random
import signal
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from .studio import Studio

# ruff: noqa: ARG002 - the signatures are the protocol's

STATES = ("running", "succeeded")
"""States that tasks go into while a job runs; they are ready for a moment only, within one commit of the record."""

STEPS = {
    "runner": (
        ("before its lease is in place", r"^os.(link|rename) \S+ \S*/runner\.lease$"),
        ("before it opens the record", r"^sqlite3.connect \S*/manifest\.db"),
        ("before the job's file is in place", r"^os.rename \S+ \S*/job\.toml$"),
        ("before it starts a worker", r"^subprocess.Popen .*pipeline\.run\.executors\.worker"),
        ("before it gives its lease back", r"^os.remove \S*/runner\.lease"),
    ),
    "worker": (
        ("before it opens its log", r"^open \S*/logs/"),
        ("before it writes an output", r"^open \S*/renders/(?!\S*/\.receipts/)\S*\.part\.\d+$"),
        ("before its receipt is written", r"^open \S*/\.receipts/\S*\.part\.\d+$"),
        ("before the output is in place", r"^os.rename \S*\.part\.\d+ \S*/(cache|frames|meshes|volumes|movie)\S*$"),
        ("between the output and its receipt", r"^os.rename \S+ \S*/\.receipts/"),
        ("between the receipt and the word of it", r"^os.remove \S*/\.receipts/\S*\.part\.\d+"),
        ("before a checkpoint is in place", r"^os.rename \S+ \S*/checkpoints/"),
    ),
}
"""Steps of each kind of process, as `hooks/sitecustomize.py` sees them coming."""


class Moment(Protocol):
    """A moment of a run."""

    told: str

    def arm(self, studio: Studio) -> None:
        """From now on it may come."""

    def has_come(self, studio: Studio) -> bool:
        """Whether it is now."""


@dataclass
class AfterSeconds:
    """Some time after the last fault or the start of the run."""

    seconds: float
    told: str = "at a random time"
    _from: float = 0.0

    def arm(self, studio: Studio) -> None:
        self._from = time.monotonic()

    def has_come(self, studio: Studio) -> bool:
        return time.monotonic() - self._from >= self.seconds


@dataclass
class AtTransition:
    """One more task of a stage is in a state than there was."""

    stage: str
    state: str
    _before: Counter[tuple[str, str]] = field(default_factory=Counter)

    @property
    def told(self) -> str:
        return f"{self.stage} {self.state}"

    def arm(self, studio: Studio) -> None:
        self._before = _counts(studio)

    def has_come(self, studio: Studio) -> bool:
        now = _counts(studio)
        key = (self.stage, self.state)
        came = now[key] > self._before[key]
        # Falling counts set a new mark: a run begins by setting every task's state anew.
        self._before[key] = min(now[key], self._before[key])
        return came


@dataclass
class AtCommit:
    """So many more outputs are committed."""

    more: int
    told: str = "at a commit"
    _before: int = 0

    def arm(self, studio: Studio) -> None:
        self._before = len(studio.commits())

    def has_come(self, studio: Studio) -> bool:
        return len(studio.commits()) >= self._before + self.more


@dataclass
class AtStep:
    """A process is about to do something: it gets SIGKILL there, by itself."""

    role: str
    told: str
    pattern: str

    def arm(self, studio: Studio) -> None:
        studio.untell("failpoint.hit")
        studio.tell("failpoint", f"{self.role} {int(signal.SIGKILL)} {self.pattern}")

    def has_come(self, studio: Studio) -> bool:
        return (studio.control / "failpoint.hit").exists()


def _counts(studio: Studio) -> Counter[tuple[str, str]]:
    return Counter((task.partition("/")[0], state) for task, state in studio.states().items())


class Deck:
    """Moments to draw from. Each transition and each step comes once before any comes again."""

    def __init__(self, chance: random.Random, stages: list[str]) -> None:
        self._chance = chance
        self._transitions = [(stage, state) for stage in stages for state in STATES]
        self._decks: dict[str, list[tuple[str, str]]] = {}

    def draw(self, role: str | None, studio: Studio, *, longest_s: float, starting: bool) -> Moment:
        """A moment for a fault, one that can still come.

        Args:
            role: kind of process that is to be killed, "runner" or "worker"; None for any other fault.
            studio: where the job is.
            longest_s: longest time until a moment that is no other [s].
            starting: the runner is about to start.
        """
        sort = self._chance.random()
        if role == "runner" and starting and sort < 0.6:
            return AtStep(role, *self._take("starting", STEPS["runner"][:4]))
        if role in STEPS and sort < 0.4:
            return AtStep(role, *self._take(role, STEPS[role][4:] if role == "runner" else STEPS[role]))
        if sort < 0.75 and (open_ones := self._open_transitions(studio)):
            return AtTransition(*self._take("transitions", open_ones))
        if sort < 0.9:
            return AtCommit(self._chance.randint(1, 3))
        return AfterSeconds(self._chance.uniform(0.0, longest_s))

    def _open_transitions(self, studio: Studio) -> list[tuple[str, str]]:
        """Those of stages that are not done yet."""
        states = studio.states()
        done = {"succeeded", "up to date"}
        still_open = {task.partition("/")[0] for task, state in states.items() if state not in done}
        return [each for each in self._transitions if not states or each[0] in still_open]

    def _take(self, name: str, allowed: Sequence[tuple[str, str]]) -> tuple[str, str]:
        """The next card that is allowed. The deck is shuffled anew when it has none."""
        deck = self._decks.setdefault(name, [])
        if not set(deck) & set(allowed):
            deck += self._chance.sample(allowed, len(allowed))
        card = next(each for each in deck if each in allowed)
        deck.remove(card)
        return card
