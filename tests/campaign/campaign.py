"""The campaign: an undisturbed run, then rounds of faults, each submitted again until the job is done."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from .family import Family
from .faults import KINDS, Kind, Situation, mount_disk
from .moments import AfterSeconds, AtStep, Deck, Moment
from .promises import broken_promises
from .studio import Studio
from .table import Result, Row

MIXED = "all of these, mixed"
PATIENCE_S = 1500.0
"""A run takes seconds, minutes on a machine that is busy with other things, and two more for each worker of six that
stop for ever one after the other; only a hang gets here."""
PROCESSES_END_WITHIN_S = 30.0
_POLL_S = 0.02
_RUNNER_IS_BUSY = 4


@dataclass(frozen=True)
class Undisturbed:
    """What the run that nobody disturbed gave and took."""

    artifacts: Mapping[str, str]
    processor_s: float
    seconds: float
    stages: list[str]


def draw_kinds(chance: random.Random, kinds: Sequence[Kind], count: int) -> list[Kind]:
    """The kinds of a mixed round; none comes twice before all have come."""
    drawn: list[Kind] = []
    while len(drawn) < count:
        drawn += chance.sample(kinds, min(len(kinds), count - len(drawn)))
    return drawn


class Campaign:
    """Rounds of faults over one job.

    Args:
        folder: works in it; a round's folder is removed when it kept every promise.
        seed: of the generator that draws kinds and moments.
        scene: what is simulated, a key of `studio.SCENES`.
        may_mount: small disks can be mounted.
        in_haste: do without the second undisturbed run.
        say: takes a line for the user.
        save: takes the result so far, after each round.
    """

    def __init__(
        self,
        folder: Path,
        *,
        seed: int,
        scene: str,
        may_mount: bool,
        in_haste: bool,
        say: Callable[[str], None],
        save: Callable[[Result], None],
    ) -> None:
        self._folder = folder
        self._scene = scene
        self._may_mount = may_mount
        self._in_haste = in_haste
        self._say = say
        self._save = save
        self._chance = random.Random(seed)
        self._family = Family()
        self._undisturbed = self._run_undisturbed()
        self._deck = Deck(self._chance, self._undisturbed.stages)
        self.result = Result(seed, scene, self._undisturbed.processor_s, len(self._undisturbed.artifacts))

    def run(self, kills: int, *, per_round: int, until: float, kinds: tuple[Kind, ...] = KINDS) -> None:
        """Inject so many faults, in rounds of one kind each and of all kinds mixed.

        Args:
            kills: how many faults in all.
            per_round: how many in a round, at most.
            until: monotonic time at which no further round begins [s].
            kinds: the kinds to choose from.
        """
        left, number = kills, 0
        first = 7 * (self.result.seed - 1)  # a short campaign of another seed has other kinds
        while left > 0 and time.monotonic() < until:
            # Two rounds of one kind each, then one of all; a campaign of one round has all.
            chosen = (
                None if number % 3 == 2 or kills <= per_round else kinds[(first + number - number // 3) % len(kinds)]
            )
            count = min(per_round, left)
            drawn = draw_kinds(self._chance, kinds, count) if chosen is None else [chosen] * count
            number += 1
            name = MIXED if chosen is None else chosen.name
            row = self._play(number, name, drawn)
            left -= row.injected
            self._say(
                f"round {number}: {name}: {row.injected} injected, {row.runs} runs, "
                + ("all promises kept" if not row.broken else "; ".join(row.broken))
                + f"; {kills - left} of {kills}"
            )
            self._save(self.result)

    def close(self) -> None:
        """End whatever runs still; nothing does unless the campaign was broken off."""
        self._family.left_over(0.0)

    def _run_undisturbed(self) -> Undisturbed:
        """Twice, unless in haste: the first warms caches up, and the second must be like it."""
        found = None
        for name in ("undisturbed",) if self._in_haste else ("warm-up", "undisturbed"):
            studio = Studio.open(self._folder / name, scene=self._scene)
            before, began = self._family.processor_s, time.monotonic()
            runner = self._family.adopt(studio.submit())
            runner.returncode = self._family.wait(runner.pid, PATIENCE_S)
            if runner.returncode != 0 or self._family.left_over(PROCESSES_END_WITHIN_S):
                raise SystemExit(f"the undisturbed run failed:\n{studio.printed()}")
            artifacts = studio.artifacts()
            if found is not None and found.artifacts != artifacts:
                raise SystemExit("two undisturbed runs differ")
            stages = [*dict.fromkeys(task.partition("/")[0] for task in studio.states())]
            found = Undisturbed(artifacts, self._family.processor_s - before, time.monotonic() - began, stages)
            shutil.rmtree(studio.folder)
        assert found is not None
        self._say(f"undisturbed: {len(found.artifacts)} outputs, {found.processor_s:.1f} s of processor time")
        return found

    # --- one round ---

    def _play(self, number: int, name: str, kinds: list[Kind]) -> Row:
        studio = Studio.open(self._folder / f"round-{number:03d}", scene=self._scene)
        own_disk = self._may_mount and any(kind.own_disk for kind in kinds)
        if own_disk:
            mount_disk(studio.renders)
        situation = Situation(studio, self._family, self._chance, may_mount=own_disk)
        round_ = _Round(situation, kinds, self._deck, self._undisturbed.seconds, self.result)
        before = self._family.processor_s
        try:
            round_.play()
        except (TimeoutError, RuntimeError) as error:
            round_.row.broken.append(str(error))
            self._family.left_over(0.0)
        row = round_.row
        row.processor_s = self._family.processor_s - before - self._undisturbed.processor_s
        row.made_again = max(0, len(studio.commits()) - len(self._undisturbed.artifacts))
        studio.untell("clock", "refuse", "failpoint", "balloon")
        row.broken += broken_promises(studio, self._undisturbed.artifacts, situation.harmed)
        row.broken += round_.afterwards()
        if not row.broken:
            row.survived = row.injected
        if own_disk:
            kept = studio.folder / "kept"
            if row.broken:
                shutil.copytree(studio.renders, kept, symlinks=True)
            subprocess.run(["umount", "-l", studio.renders], check=True)
        if not row.broken:
            shutil.rmtree(studio.folder)
        row.broken = [f"{sentence} (round {number})" for sentence in row.broken]
        self._add(name, row)
        return row

    def _add(self, name: str, row: Row) -> None:
        total = self.result.rows[name]
        for key in ("injected", "survived", "runs", "processor_s", "made_again", "broken"):
            setattr(total, key, getattr(total, key) + getattr(row, key))


class _Round:
    """One job under a few faults, submitted again until it is done."""

    def __init__(
        self, situation: Situation, kinds: list[Kind], deck: Deck, undisturbed_s: float, result: Result
    ) -> None:
        self._situation = situation
        self._studio = situation.studio
        self._family = situation.family
        self._left = list(kinds)
        self._deck = deck
        self._undisturbed_s = undisturbed_s
        self._result = result
        self._armed: tuple[Kind, Moment] | None = None
        self._armed_at = 0.0
        self._relief: tuple[float, Callable[[Situation], None]] | None = None
        self.row = Row()

    def play(self) -> None:
        """Submit until the job is done.

        Raises:
            RuntimeError: it does not get done, or something is left over from a run that has ended.
            TimeoutError: a run does not end.
        """
        most = 4 * (len(self._left) + 1)
        while True:
            self.row.runs += 1
            if self.row.runs > most:
                raise RuntimeError(f"the job is not done after {most} submits")
            code = self._run_once()
            if left := self._family.left_over(PROCESSES_END_WITHIN_S):
                raise RuntimeError(f"left over from a run that ended with {code}: {'; '.join(left)}")
            if code == _RUNNER_IS_BUSY:
                raise RuntimeError("the lease of a dead runner was taken for a live one's")
            if code == 0 and not self._strike_when_done():
                return

    def afterwards(self) -> list[str]:
        """What a finished job still has to show: that there is nothing to do."""
        broken, before = [], len(self._studio.printed())
        again = self._family.adopt(self._studio.submit())
        again.returncode = self._family.wait(again.pid, PATIENCE_S)
        if again.returncode != 0 or not self._studio.printed()[before:].startswith("up to date"):
            broken.append(f"a finished job has something to do; submitted again it ends with {again.returncode}")
        return broken

    # --- one run ---

    def _run_once(self) -> int:
        """One submit, from its start to its end."""
        self._arm(starting=True)
        runner = self._family.adopt(self._studio.submit())
        self._situation.runner = runner.pid
        until = time.monotonic() + PATIENCE_S
        while (code := self._family.exit_code(runner.pid)) is None:
            if time.monotonic() > until:
                raise TimeoutError(f"a run has not ended after {PATIENCE_S:g} s")
            self._arm(starting=False)
            self._strike()
            self._relieve(due_only=True)
            time.sleep(_POLL_S)
        runner.returncode = code
        self._situation.runner = None
        self._count_step()
        self._relieve(due_only=False)
        return code

    def _arm(self, *, starting: bool) -> None:
        if self._armed is None and self._relief is None and self._left:
            kind = self._left.pop(0)
            moment = self._deck.draw(kind.role, self._studio, longest_s=self._undisturbed_s / 2, starting=starting)
            moment.arm(self._studio)
            self._armed = kind, moment
            self._armed_at = time.monotonic()

    def _strike(self) -> None:
        """Inject the fault that is due, if its moment has come and it finds something to act on."""
        if self._armed is None:
            return
        kind, moment = self._armed
        if not moment.has_come(self._studio):
            if time.monotonic() - self._armed_at > self._undisturbed_s:
                self._studio.untell("failpoint")  # it does not come any more, it seems
                self._armed = kind, AfterSeconds(0.0)
            return
        if isinstance(moment, AtStep):
            self._count(kind, moment)
            return
        if kind.between_runs:
            if not self._studio.commits():
                return
            assert self._situation.runner is not None
            os.kill(self._situation.runner, signal.SIGKILL)
            self._family.wait(self._situation.runner, PATIENCE_S)
            self._family.left_over(PROCESSES_END_WITHIN_S)
        if kind.inject(self._situation):
            self._count(kind, moment)

    def _count_step(self) -> None:
        """A runner that fell at one of its own steps ends before we look."""
        if self._armed is not None and isinstance(self._armed[1], AtStep) and self._armed[1].has_come(self._studio):
            self._count(*self._armed)

    def _strike_when_done(self) -> bool:
        """A finished job can still be damaged. Returns whether the job has to be submitted again."""
        if self._armed is not None and not self._armed[0].between_runs:
            self._armed = None  # its moment did not come any more
            self._studio.untell("failpoint")
        struck = False
        while self._armed is not None or (self._left and self._left[0].between_runs):
            if self._armed is None:
                kind = self._left.pop(0)
                self._armed = kind, AfterSeconds(0.0)
            kind, moment = self._armed
            if kind.inject(self._situation):
                struck = True
                self._count(kind, moment, told="when the job was done")
            self._armed = None
        self._relieve(due_only=False)
        return struck

    def _count(self, kind: Kind, moment: Moment, told: str = "") -> None:
        self._armed = None
        self.row.injected += 1
        self._result.moments[told or moment.told] += 1
        if kind.relieve is not None:
            lasts = self._situation.chance.uniform(*kind.lasts_s) if kind.lasts_s else float("inf")
            self._relief = time.monotonic() + lasts, kind.relieve

    def _relieve(self, *, due_only: bool) -> None:
        if self._relief is not None and (not due_only or self._relief[0] <= time.monotonic()):
            self._relief[1](self._situation)
            self._relief = None
