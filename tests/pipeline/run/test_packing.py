"""Which tasks run beside which: what they need, machines that come and go, and who may overtake whom."""

import pytest
from scheduled_tasks import TWO_CORES, commit, fail, film, started, succeed, task

from pipeline.base.task import FailureKind, Resources
from pipeline.run.events import CapacityChanged, Start, Tick
from pipeline.run.scheduler import Scheduler


def test_all_cores_of_a_task_are_those_of_one_machine_and_other_machines_go_on():
    tasks = [task("simulate", resources=Resources(cores=0)), *(task(f"render/{k}", frame=k) for k in range(3))]
    scheduler = Scheduler(tasks, capacity=Resources(cores=4), machine=TWO_CORES)
    instructions = scheduler.start()
    assert instructions[0] == Start(tasks[0], threads=2, need=Resources(cores=2))
    assert started(instructions) == ["simulate", "render/0", "render/1"]


def test_machines_that_come_are_used_at_once_and_those_that_go_are_not_missed_by_what_runs():
    tasks = [task(f"render/{k}", frame=k) for k in range(6)]
    scheduler = Scheduler(tasks, capacity=TWO_CORES)
    assert started(scheduler.start()) == ["render/0", "render/1"]
    assert started(scheduler.handle(CapacityChanged(Resources(cores=4)))) == ["render/2", "render/3"]
    assert started(scheduler.handle(CapacityChanged(TWO_CORES))) == []
    assert started(succeed(scheduler, tasks[0])) == started(succeed(scheduler, tasks[1])) == []
    assert started(succeed(scheduler, tasks[2])) == ["render/4"]


def test_a_task_for_a_machine_that_went_is_given_out_and_waits_for_another():
    """The executor knows how long to wait; here nothing may stand still for ever."""
    tasks = [task("simulate", resources=Resources(cores=0)), task("bake", resources=Resources(cores=0))]
    scheduler = Scheduler(tasks, capacity=Resources(cores=4), machine=Resources(cores=4))
    assert started(scheduler.start()) == ["simulate"]
    assert started(scheduler.handle(CapacityChanged(Resources(cores=1)))) == []
    assert started(succeed(scheduler, tasks[0])) == ["bake"]


def test_out_of_memory_is_tried_again_with_a_whole_machine_and_not_with_all_of_them():
    tasks = [task(f"render/{k}", frame=k) for k in range(4)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=4), machine=TWO_CORES)
    assert len(started(scheduler.start())) == 4
    assert fail(scheduler, "render/0", FailureKind.OUT_OF_MEMORY) == []
    assert scheduler.handle(Tick(1000.0)) == []
    retried = succeed(scheduler, tasks[1])
    assert retried == [Start(tasks[0], threads=1, need=Resources(cores=2))]


def test_a_simulation_on_all_cores_runs_alone():
    tasks = film(2, simulation=Resources(cores=0))
    scheduler = Scheduler(tasks, capacity=TWO_CORES)
    assert scheduler.start() == [Start(tasks[0], threads=2, need=Resources(cores=2))]
    assert started(commit(scheduler, "simulate", "cache/0")) == []
    assert started(succeed(scheduler, tasks[0])) == ["surface/0", "surface/1"]


def test_a_simulation_on_the_gpu_overlaps_with_other_stages():
    scheduler = Scheduler(film(2, simulation=Resources(cores=1, gpus=1)), capacity=Resources(cores=2, gpus=1))
    scheduler.start()
    assert started(commit(scheduler, "simulate", "cache/0")) == ["surface/0"]


def test_memory_is_never_overcommitted():
    tasks = [task(f"render/{k}", frame=k, resources=Resources(memory_bytes=6)) for k in range(3)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=8, memory_bytes=13))
    assert started(scheduler.start()) == ["render/0", "render/1"]


def test_a_task_larger_than_the_machine_runs_alone():
    tasks = [task("big", resources=Resources(cores=64, memory_bytes=99)), task("small/0", frame=0)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=2, memory_bytes=10))
    assert started(scheduler.start()) == ["big"]
    assert started(succeed(scheduler, tasks[0])) == ["small/0"]


def test_a_task_that_needs_an_absent_gpu_is_refused():
    with pytest.raises(ValueError, match="simulate needs 1 GPUs, but this machine offers 0"):
        Scheduler(film(1, simulation=Resources(gpus=1)), capacity=TWO_CORES)


def test_small_tasks_do_not_starve_a_big_one_that_is_more_urgent():
    big = task("big", ("first.out",), resources=Resources(cores=4))
    small = [task(f"small/{k}", frame=k) for k in range(20)]
    first = task("first")
    scheduler = Scheduler([first, big, *small], capacity=Resources(cores=4))
    assert started(scheduler.start()) == ["first", "small/0", "small/1", "small/2"]
    # From here the big one waits for all four cores; nothing may slip in before it.
    assert started(succeed(scheduler, first)) == []
    assert started(succeed(scheduler, small[0])) == []
    assert started(succeed(scheduler, small[1])) == []
    assert started(succeed(scheduler, small[2])) == ["big"]


def test_tasks_that_do_not_delay_a_blocked_one_may_overtake_it():
    gpu = Resources(cores=1, gpus=1)
    tasks = [task(f"gpu/{k}", frame=k, resources=gpu) for k in range(2)]
    tasks += [task(f"cpu/{k}", frame=9) for k in range(9)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=4, gpus=1))
    assert started(scheduler.start()) == ["gpu/0", "cpu/0", "cpu/1", "cpu/2"]
    # Three of four cores are with those that overtook gpu/1, so it has its core as soon as it has the GPU.
    assert started(succeed(scheduler, tasks[2])) == ["cpu/3"]
    assert started(succeed(scheduler, tasks[0])) == ["gpu/1"]
