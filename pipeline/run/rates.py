"""Rates of this machine: how long work takes here, measured in a moment at first use, and learnt from every run after.

A small file in the user's cache folder, beside the kept kernels: one entry a machine, as home folders may be shared.
Losing it costs nothing but a moment's measurement, and estimates that are as rough as at first.
"""

from __future__ import annotations

import json
import math
import platform
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.base.files import locked, replacing
from pipeline.base.parameter_set import digest_of
from pipeline.base.resources import machine_capacity
from sim.core.runtime import cache_folder

MEASURED_S = 0.04
"""Time of each measurement [s]; the best of `TRIES` counts, as others may use the machine."""
TRIES = 2
ROUNDS_OF_REFERENCE = 2100.0
"""Rounds a second of the measurement on a core of the reference machine of `pipeline.kinds.work`."""
_ELEMENTS = 1 << 18
"""Of each round: so many that threads seldom wait for the interpreter."""
LARGEST_CORRECTION = 4.0
"""A run that was so much slower or faster than expected was stopped, or something else was wrong with it."""
NEWEST_WEIGHT = 0.3
"""Least weight of the newest run."""


class Factors(NamedTuple):
    """What a kind of work took here over what was expected [-]."""

    time: float = 1.0
    bytes: float = 1.0
    memory: float = 1.0
    runs: int = 0  # in which it was measured


@dataclass(frozen=True)
class MachineRates:
    """Rates of a machine."""

    one_core: float  # speed of one core, over that of the reference [-]
    all_cores: float  # of all of them together, over that of one core of the reference [-]
    cores: int  # how many were measured
    learnt: dict[str, Factors] = field(default_factory=dict)  # by what work is called

    def factors(self, name: str) -> Factors:
        """The factors of a kind of work: its own, or the mean of what is known of its stage and device.

        Names are `stage:device:what`.
        """
        if name in self.learnt:
            return self.learnt[name]
        family = name.rpartition(":")[0]
        known = [each for other, each in self.learnt.items() if other.rpartition(":")[0] == family]
        if not known:
            return Factors()
        time_factor = math.exp(sum(math.log(each.time) for each in known) / len(known))
        return Factors(time_factor, runs=0)

    def is_known(self, name: str) -> bool:
        """Whether this work was measured here."""
        return name in self.learnt

    def shared_speed(self, cores: int) -> float:
        """Speed of so many of its cores together, over that of one core of the reference [-]."""
        share = min(1.0, cores / self.cores)
        return max(self.one_core * share, self.all_cores * share)

    def taught(self, name: str, *, time: float, size: float, memory: float) -> MachineRates:
        """With what a run has measured of a work, each over what was expected without factors; 0: not measured."""
        old = self.learnt.get(name, Factors())
        weight = max(NEWEST_WEIGHT, 1.0 / (old.runs + 1))
        new = Factors(
            _blend(old.time, time, weight),
            _blend(old.bytes, size, weight),
            _blend(old.memory, memory, weight),
            old.runs + 1,
        )
        return replace(self, learnt={**self.learnt, name: new})


def _blend(old: float, measured: float, weight: float) -> float:
    """Between the two, by their logarithms."""
    if measured <= 0.0:
        return old
    bounded = min(LARGEST_CORRECTION, max(1.0 / LARGEST_CORRECTION, measured))
    return float(old ** (1.0 - weight) * bounded**weight)


def known_rates() -> MachineRates | None:
    """The rates of this machine as they were kept; None if it was never measured."""
    try:
        kept = json.loads(rates_file().read_text(encoding="utf-8"))
        learnt = {str(name): Factors(*each) for name, each in kept["learnt"].items()}
        rates = MachineRates(float(kept["one_core"]), float(kept["all_cores"]), int(kept["cores"]), learnt)
    except (OSError, KeyError, TypeError, ValueError, AttributeError):
        return None
    return rates if rates.one_core > 0.0 and rates.all_cores > 0.0 and rates.cores > 0 else None


def measure() -> MachineRates:
    """Measure this machine's processor, in some tenths of a second, and keep that."""
    cores = machine_capacity().cores
    one, together = _rounds_a_second(1), _rounds_a_second(cores)
    rates = MachineRates(one / ROUNDS_OF_REFERENCE, max(one, together) / ROUNDS_OF_REFERENCE, cores)
    with _alone():
        if (known := known_rates()) is not None:  # of another process, which was faster
            return known
        keep(rates)
    return rates


def learn(change: Callable[[MachineRates], MachineRates]) -> None:
    """Change the rates that are kept, if there are any, whatever other processes learn meanwhile."""
    with _alone():
        rates = known_rates()
        if rates is not None:
            keep(change(rates))


@contextmanager
def _alone() -> Iterator[None]:
    """Exclude other processes that change the rates; where no lock can be had, what one of two learns is lost."""
    with ExitStack() as stack:
        with suppress(OSError):
            lock = rates_file().with_suffix(".lock")
            lock.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(locked(lock))
        yield


def keep(rates: MachineRates) -> None:
    """Keep the rates of this machine; a cache folder that cannot be written costs the next command a measurement."""
    with suppress(OSError), replacing(rates_file()) as part:
        part.write_text(json.dumps(asdict(rates), indent=1), encoding="utf-8")


def rates_file() -> Path:
    """Where the rates of this machine are kept: a file a machine, as home folders may be shared."""
    return cache_folder() / "rates" / f"{_machine()}.json"


def _machine() -> str:
    """Digest of what tells this machine from others, and its cores from those of a container on it."""
    model = ""
    with suppress(OSError):
        lines: Iterable[str] = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line for line in lines if line.startswith("model name")), "")
    return digest_of(f"{platform.node()}\n{model}\n{machine_capacity().cores}")[:32]


def _rounds_a_second(threads: int) -> float:
    """Rounds of gathers and roots, as of pairs of particles, that threads finish in a second together.

    By processor time, as if nothing else ran: that others do now says little of the hours to come.
    """
    best = 0.0
    for _ in range(TRIES):
        rates = [0.0] * threads
        workers = [threading.Thread(target=_work, args=(rates, index)) for index in range(threads)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        best = max(best, sum(rates))
    return best


def _work(rates: list[float], index: int) -> None:
    generator = np.random.default_rng(index)
    values = generator.random(_ELEMENTS, dtype=np.float32)
    places = generator.integers(0, _ELEMENTS, _ELEMENTS)
    gathered = np.empty_like(values)
    began, end, rounds = time.thread_time(), time.perf_counter() + MEASURED_S, 0
    while time.perf_counter() < end:
        np.take(values, places, out=gathered, mode="clip")
        np.multiply(gathered, values, out=gathered)
        np.sqrt(gathered, out=gathered)
        rounds += 1
    rates[index] = rounds / max(1e-6, time.thread_time() - began)
