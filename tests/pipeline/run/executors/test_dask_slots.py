"""Which Dask worker gets a task."""

from pipeline.base.task import Resources
from pipeline.run.executors.dask_slots import Offer, Slots, offer_from

ONE = Resources(cores=1)


def offer(address: str, cores: int = 2, *, gpus: int = 0, identity: str = "first", threads: int = 8) -> Offer:
    resources = Resources(cores, memory_bytes=1000 * cores, gpus=gpus)
    return Offer(address, identity, f"host of {address}", resources, threads)


def slots(*offers: Offer) -> Slots:
    slots = Slots()
    slots.update({each.address: each for each in offers})
    return slots


def take(slots: Slots, need: Resources = ONE, stage: str = "render", reserved: tuple[str, ...] = ()) -> str | None:
    taken = slots.take(need, stage=stage, reserved=reserved)
    return None if taken is None else taken.address


def test_a_task_goes_where_it_fits_and_nowhere_else():
    workers = slots(offer("a", 1), offer("b", 1))
    assert {take(workers), take(workers)} == {"a", "b"}
    assert take(workers) is None


def test_a_stage_goes_where_it_was_before():
    workers = slots(offer("a", 4), offer("b", 8))
    first = workers.take(ONE, stage="surface")
    assert first is not None
    workers.give_back(first, ONE)
    big = workers.take(ONE, stage="render", reserved=[first.address])
    assert big is not None
    assert take(workers, stage="surface") == first.address
    assert take(workers, stage="render") == big.address


def test_a_task_without_a_warm_worker_fills_the_fullest_one():
    workers = slots(offer("a", 8), offer("b", 2))
    assert take(workers) == "b"
    assert take(workers, Resources(cores=8)) == "a"


def test_what_fits_nowhere_yet_reserves_the_worker_that_will_have_room_first():
    workers = slots(offer("a", 4), offer("b", 4))
    assert take(workers, Resources(cores=3)) == "a"
    assert take(workers, ONE, stage="other") == "a"
    assert take(workers, ONE, stage="third") == "b"
    everything = Resources(cores=4)
    assert take(workers, everything) is None
    assert workers.emptiest(everything) == "b"
    assert take(workers, ONE, reserved=("b",)) is None
    assert workers.emptiest(Resources(cores=5)) is None


def test_a_gpu_that_failed_counts_no_more_until_its_worker_is_another():
    on_gpu = Resources(cores=1, gpus=1)
    workers = slots(offer("a", 4, gpus=2), offer("b", 4))
    first = workers.take(on_gpu, stage="simulate")
    assert first is not None
    workers.withdraw_gpu(first)
    workers.give_back(first, on_gpu)
    assert (workers.total.gpus, take(workers, on_gpu), take(workers, on_gpu)) == (1, "a", None)
    workers.update({each.address: each for each in (offer("a", 4, gpus=2), offer("b", 4))})
    assert workers.total.gpus == 1
    workers.update({"a": offer("a", 4, gpus=2, identity="second")})
    assert workers.total.gpus == 2
    workers.withdraw_gpu(first)  # of the former one
    assert workers.total.gpus == 2


def test_gpus_memory_and_threads_count():
    workers = slots(offer("cpu", 16, threads=2), offer("gpu", 1, gpus=1, threads=2))
    assert take(workers, Resources(cores=1, gpus=1)) == "gpu"
    assert take(workers, Resources(cores=1, gpus=1)) is None
    assert take(workers, Resources(cores=1, memory_bytes=15_500)) == "cpu"
    assert take(workers, Resources(cores=1, memory_bytes=1000)) is None
    assert take(workers) == "cpu"
    assert take(workers) is None  # fourteen cores are free, but it runs two tasks at a time


def test_a_worker_that_came_back_is_free_and_what_the_old_one_gives_back_is_nothing():
    workers = slots(offer("a", 1))
    old = workers.take(ONE, stage="render")
    assert old is not None
    workers.update({"a": offer("a", 1, identity="second")})
    assert take(workers) == "a"
    workers.give_back(old, ONE)
    assert take(workers) is None
    workers.update({})
    assert workers.total == Resources(0, 0, 0)


def test_a_worker_that_is_not_to_be_trusted_for_a_while_keeps_what_was_taken_of_it():
    workers = slots(offer("a", 1))
    taken = workers.take(ONE, stage="render")
    assert taken is not None
    workers.remove("a")
    assert (take(workers), workers.emptiest(ONE), workers.offers) == (None, None, [])
    workers.update({}, present={"a"})  # it has yet to say who it is
    assert workers.offers == []
    workers.update({"a": offer("a", 1)})
    assert (take(workers), workers.offers) == (None, [taken])
    workers.give_back(taken, ONE)
    assert take(workers) == "a"


def test_a_need_put_together_from_several_workers_is_cut_to_the_best_of_them():
    cpu, gpu = Resources(16, 64_000_000_000, 0), Resources(8, 32_000_000_000, 1)
    workers = slots(*(Offer(name, "first", name, each, 8) for name, each in (("cpu", cpu), ("gpu", gpu))))
    assert workers.clamp(Resources(16, 64_000_000_000, 1)) == gpu
    assert workers.clamp(cpu) == cpu
    assert workers.clamp(Resources(2, 0, 2)) == Resources(2, 0, 2)  # no machine has two
    workers.update({"gpu": Offer("gpu", "first", "gpu", gpu, 8)})
    assert workers.clamp(cpu) == cpu  # its like may come back


def test_total_and_largest():
    workers = slots(offer("a", 16), offer("b", 2, gpus=1))
    assert workers.total == Resources(18, 18_000, 1)
    assert workers.largest == Resources(16, 16_000, 1)
    workers.remove("a")
    assert workers.largest == Resources(2, 2000, 1)


def test_tags_say_what_a_worker_offers_and_only_they_are_asked_for():
    def made(**tags: float) -> Offer:
        info = {"resources": tags, "nthreads": 4, "memory_limit": 7, "host": "10.0.0.1"}
        return offer_from("tcp://10.0.0.1:1", info, identity="x")

    assert made().resources == Resources(4, 7, 0)
    assert made(CPU=2.0, MEM=5e9, GPU=1.0).resources == Resources(2, 5_000_000_000, 1)
    assert made(CPU=2.0).resources == Resources(2, 7, 0)
    assert made(CPU=2.0).demand(Resources(2, 5, 1)) == {"CPU": 2.0}
