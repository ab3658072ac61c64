"""Which Dask worker gets a task: arithmetic on what workers offer and what is taken of it.

Workers say what they offer with Dask's resource tags: `--resources "CPU=16 MEM=64e9 GPU=1"`. Dask's own scheduler would
put tasks with tags into the queues of workers that are busy, so the worker is chosen here.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
from typing import Any

from pipeline.base.task import Resources

CPU_TAG, MEMORY_TAG, GPU_TAG = "CPU", "MEM", "GPU"


@dataclass(frozen=True, slots=True)
class Offer:
    """A Dask worker."""

    address: str  # where it listens
    identity: str  # name of this incarnation; one that was restarted at the same address has another
    host: str
    resources: Resources  # what tasks may occupy of it
    threads: int  # how many tasks it runs at a time
    # the resource tags that it has. Dask runs no task that asks for a tag which its worker does not have
    tags: frozenset[str] = frozenset()

    def demand(self, need: Resources) -> dict[str, float]:
        """A need in this worker's tags, so that Dask keeps several runners from taking the same cores."""
        amounts = {CPU_TAG: need.cores, MEMORY_TAG: need.memory_bytes, GPU_TAG: need.gpus}
        return {tag: float(amount) for tag, amount in amounts.items() if amount and tag in self.tags}


def offer_from(address: str, info: Mapping[str, Any], *, identity: str) -> Offer:
    """What a worker offers, by what Dask's scheduler tells of it.

    Where a tag is missing, that is its number of threads, its memory limit, and no GPU.
    """
    tags = info["resources"]
    resources = Resources(
        cores=int(tags.get(CPU_TAG, info["nthreads"])),
        memory_bytes=int(tags.get(MEMORY_TAG, info["memory_limit"])),
        gpus=int(tags.get(GPU_TAG, 0)),
    )
    return Offer(address, identity, info["host"], resources, info["nthreads"], frozenset(tags))


@dataclass(slots=True)
class _Worker:
    offer: Offer
    free: Resources
    threads: int
    stages: set[str] = field(default_factory=set)
    trusted: bool = True


class Slots:
    """What of the workers is free. Not safe to use from several threads."""

    def __init__(self) -> None:
        self._workers: dict[str, _Worker] = {}
        self._seen: set[Resources] = set()

    @property
    def offers(self) -> list[Offer]:
        """The workers that tasks are given to."""
        return [worker.offer for worker in self._trusted(())]

    @property
    def total(self) -> Resources:
        """All workers together."""
        return reduce(add, (offer.resources for offer in self.offers), Resources(0, 0, 0))

    @property
    def largest(self) -> Resources:
        """The most that a single worker has, of each; no worker need have all of it, see `clamp`."""
        return reduce(Resources.at_least, (offer.resources for offer in self.offers), Resources(0, 0, 0))

    def update(self, offers: Mapping[str, Offer], present: Collection[str] = ()) -> None:
        """Take in which workers there are now: `offers` by address, and addresses of others that are `present`.

        One that went takes what was taken of it with it; one that came back as another incarnation is free. One that is
        there still and offers nothing, because it is paused or has yet to say who it is, keeps its tasks meanwhile.
        """
        for address, worker in [*self._workers.items()]:
            if address in offers:
                if offers[address].identity != worker.offer.identity:
                    del self._workers[address]
            elif address in present:
                worker.trusted = False
            else:
                del self._workers[address]
        for address, offer in offers.items():
            self._workers.setdefault(address, _Worker(offer, offer.resources, offer.threads)).trusted = True
            self._seen.add(offer.resources)

    def remove(self, address: str) -> None:
        """Give the worker at this address nothing more, until an update lists it again; it keeps what it has."""
        if address in self._workers:
            self._workers[address].trusted = False

    def withdraw_gpu(self, offer: Offer) -> None:
        """Count a GPU of this worker no more, until it comes back as another incarnation."""
        worker = self._workers.get(offer.address)
        if worker is not None and worker.offer.identity == offer.identity and worker.offer.resources.gpus:
            gone = Resources(0, 0, 1)
            worker.offer = replace(worker.offer, resources=worker.offer.resources - gone)
            worker.free = worker.free - gone

    def clamp(self, need: Resources) -> Resources:
        """A need that a single worker can meet, where the given one is put together from several.

        Who asks for more cores and memory than there are together gets all of one worker: that with the most memory of
        those with enough GPUs. Workers that went count: a need that one of them met waits for its like.
        """
        able = [each for each in self._seen if need.gpus <= each.gpus]
        if not able or any(need.fits(each) for each in able):
            return need
        best = max(able, key=lambda each: (min(need.memory_bytes, each.memory_bytes), each.cores, -each.gpus))
        return Resources(min(need.cores, best.cores), min(need.memory_bytes, best.memory_bytes), need.gpus)

    def take(self, need: Resources, *, stage: str, reserved: Collection[str] = ()) -> Offer | None:
        """Choose a worker for a task and take what the task needs of it; None when it fits nowhere now.

        Of those that it fits on, one that has run the stage before, so that Blender is warm there; else the fullest, so
        that room is left for tasks that need more. Workers at `reserved` addresses are kept for others.
        """
        fitting = [each for each in self._trusted(reserved) if each.threads > 0 and need.fits(each.free)]
        if not fitting:
            return None
        best = min(fitting, key=lambda each: (stage not in each.stages, each.free.cores, each.offer.address))
        best.free = best.free - need
        best.threads -= 1
        best.stages.add(stage)
        return best.offer

    def emptiest(self, need: Resources, *, reserved: Collection[str] = ()) -> str | None:
        """Address of the worker that will have room for this need first, going by its free cores; None: none ever."""
        able = [each for each in self._trusted(reserved) if need.fits(each.offer.resources)]
        return max(able, key=lambda each: (each.free.cores, each.offer.address)).offer.address if able else None

    def _trusted(self, reserved: Collection[str]) -> list[_Worker]:
        """The workers that may get tasks, but for those at addresses that are kept for others."""
        return [each for address, each in self._workers.items() if each.trusted and address not in reserved]

    def give_back(self, offer: Offer, need: Resources) -> None:
        """A task has ended; nothing happens if its worker is gone."""
        worker = self._workers.get(offer.address)
        if worker is not None and worker.offer.identity == offer.identity:
            worker.free = worker.free + need
            worker.threads += 1
