"""The scheduler: events in, instructions out; nothing here touches a clock, a file or a process."""

import pickle
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scheduled_tasks import TWO_CORES, begun, commit, fail, film, finished, outcome, started, succeed, task

from pipeline.base.resources import claim
from pipeline.base.task import ArtifactPath, FailureKind, Policy, Resources, Task, TaskId, TaskState
from pipeline.run.events import (
    CancelRequested,
    DrainRequested,
    Finish,
    JobOutcome,
    Kill,
    Skipped,
    Start,
    Stop,
    Tick,
)
from pipeline.run.scheduler import TERMINAL_STATES, InvalidTransitionError, Scheduler


def test_a_commit_of_a_running_task_starts_its_reader_at_once():
    scheduler = Scheduler(film(3), capacity=TWO_CORES)
    assert started(scheduler.start()) == ["simulate"]
    assert started(commit(scheduler, "simulate", "cache/0")) == ["surface/0"]
    assert scheduler.state(TaskId("simulate")) is TaskState.RUNNING


def test_lower_frames_go_first_and_of_one_frame_the_later_stage():
    tasks = [task(f"{stage}/{k}", frame=k) for stage in ("surface", "render") for k in (1, 0)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=4))
    assert started(scheduler.start()) == ["render/0", "surface/0", "render/1", "surface/1"]


def test_frames_go_by_their_turns_and_of_one_frame_the_later_stage():
    tasks = [task(f"{stage}/{k}", frame=k) for stage in ("surface", "render") for k in range(3)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=6), turns=[0, 2, 1])
    assert started(scheduler.start()) == ["render/0", "surface/0", "render/2", "surface/2", "render/1", "surface/1"]


def test_of_tasks_about_the_whole_job_the_earlier_stage_goes_first():
    """Meshing bodies takes a moment; after a simulation on all cores, rendering would begin that much later."""
    tasks = [task(f"bodies/{name}") for name in "abc"] + film(1, simulation=Resources(cores=0))
    scheduler = Scheduler(tasks, capacity=TWO_CORES)
    assert started(scheduler.start()) == ["bodies/a", "bodies/b"]
    assert started(succeed(scheduler, tasks[0])) == ["bodies/c"]
    assert started(succeed(scheduler, tasks[1])) == []
    assert started(succeed(scheduler, tasks[2])) == ["simulate"]


def test_up_to_date_tasks_do_not_run_and_their_outputs_count():
    tasks = film(2)
    done = {TaskId("simulate"), TaskId("surface/0"), TaskId("render/0"), TaskId("surface/1")}
    scheduler = Scheduler(tasks, up_to_date=done, capacity=TWO_CORES)
    assert started(scheduler.start()) == ["render/1"]


def test_a_finished_job_finishes_at_once():
    tasks = film(2)
    scheduler = Scheduler(tasks, up_to_date={each.id for each in tasks}, capacity=TWO_CORES)
    assert scheduler.start() == [Finish(JobOutcome.SUCCEEDED)]


def test_what_half_a_simulation_left_lets_later_stages_start():
    scheduler = Scheduler(film(2), committed=[ArtifactPath("cache/0")], capacity=TWO_CORES)
    assert started(scheduler.start()) == ["simulate", "surface/0"]


def test_a_skipped_task_counts_as_up_to_date_and_frees_its_readers():
    scheduler = begun(film(1), committed=[ArtifactPath("cache/0")])
    assert started(scheduler.handle(Skipped(TaskId("surface/0")))) == ["render/0"]
    assert scheduler.state(TaskId("surface/0")) is TaskState.UP_TO_DATE


def test_a_failing_frame_fails_its_own_descendants_and_the_rest_goes_on():
    tasks = film(2)
    scheduler = begun(tasks, up_to_date={TaskId("simulate")})
    fail(scheduler, "surface/0", FailureKind.FAILED)
    assert scheduler.state(TaskId("render/0")) is TaskState.UPSTREAM_FAILED
    assert scheduler.state(TaskId("movie")) is TaskState.UPSTREAM_FAILED
    assert started(succeed(scheduler, tasks[2])) == ["render/1"]
    assert outcome(succeed(scheduler, tasks[4])) is JobOutcome.FAILED


def test_frames_before_a_divergence_are_still_shown():
    tasks = film(3)
    scheduler = begun(tasks)
    commit(scheduler, "simulate", "cache/0")
    fail(scheduler, "simulate", FailureKind.DIVERGED)
    assert scheduler.state(TaskId("surface/0")) is TaskState.RUNNING
    assert scheduler.state(TaskId("surface/1")) is TaskState.UPSTREAM_FAILED
    assert started(succeed(scheduler, tasks[1])) == ["render/0"]


@pytest.mark.parametrize("kind", [FailureKind.WORKER_LOST, FailureKind.STALLED, FailureKind.TIMED_OUT])
def test_a_fault_of_the_machine_is_retried_after_a_growing_pause_and_not_for_ever(kind):
    scheduler = begun([task("render/0")], policy=Policy(attempts=3, backoff_s=2.0))
    assert fail(scheduler, "render/0", kind, now=10.0) == []
    assert scheduler.next_wakeup == 12.0
    assert scheduler.handle(Tick(11.9)) == []
    assert started(scheduler.handle(Tick(12.0))) == ["render/0"]
    fail(scheduler, "render/0", kind, now=20.0)
    assert scheduler.next_wakeup == 24.0
    assert started(scheduler.handle(Tick(24.0))) == ["render/0"]
    assert outcome(fail(scheduler, "render/0", kind, now=30.0)) is JobOutcome.FAILED


@pytest.mark.parametrize("kind", [FailureKind.FAILED, FailureKind.DIVERGED])
def test_a_failure_of_the_task_itself_is_not_retried(kind):
    scheduler = begun([task("render/0")])
    assert outcome(fail(scheduler, "render/0", kind)) is JobOutcome.FAILED


def test_after_running_out_of_memory_a_task_gets_the_machine_for_itself_once():
    tasks = [task("render/0", frame=0), task("render/1", frame=1)]
    scheduler = begun(tasks)
    fail(scheduler, "render/0", FailureKind.OUT_OF_MEMORY)
    assert scheduler.handle(Tick(100.0)) == []  # render/1 still runs
    assert started(succeed(scheduler, tasks[1])) == ["render/0"]
    assert scheduler.free == Resources(cores=0)
    assert outcome(fail(scheduler, "render/0", FailureKind.OUT_OF_MEMORY)) is JobOutcome.FAILED


def test_a_lost_worker_does_not_cost_a_task_its_turn_alone_on_the_machine():
    scheduler = begun([task("render/0", frame=0)])
    fail(scheduler, "render/0", FailureKind.WORKER_LOST)
    scheduler.handle(Tick(100.0))
    fail(scheduler, "render/0", FailureKind.OUT_OF_MEMORY, now=100.0)
    assert started(scheduler.handle(Tick(200.0))) == ["render/0"]
    assert scheduler.free == Resources(cores=0)
    assert outcome(fail(scheduler, "render/0", FailureKind.OUT_OF_MEMORY, now=200.0)) is JobOutcome.FAILED


def test_a_task_that_somebody_else_stopped_is_started_again():
    scheduler = begun(film(1))
    fail(scheduler, "simulate", FailureKind.CANCELLED, now=0.0)
    assert started(scheduler.handle(Tick(60.0))) == ["simulate"]


@pytest.mark.parametrize(
    ("kind", "ending"),
    [(FailureKind.DISK_FULL, JobOutcome.DISK_FULL), (FailureKind.OUTGROWN, JobOutcome.OUTGROWN)],
)
def test_a_full_disk_or_memory_that_is_outgrown_pauses_the_job_and_fails_nothing(kind, ending):
    tasks = film(2)
    scheduler = begun(tasks)
    commit(scheduler, "simulate", "cache/0")
    assert fail(scheduler, "surface/0", kind) == [Stop(TaskId("simulate"))]
    assert outcome(fail(scheduler, "simulate", FailureKind.CANCELLED)) is ending
    assert {state for _, state in scheduler.counts()} == {TaskState.CANCELLED}


def test_past_a_share_of_failures_the_job_stops():
    tasks = [task(f"render/{k}", frame=k) for k in range(100)]
    scheduler = Scheduler(tasks, capacity=Resources(cores=1), policy=Policy(failure_count=3, failure_share=0.5))
    scheduler.start()
    for k in range(3):
        succeed(scheduler, tasks[k])
    assert [outcome(fail(scheduler, f"render/{k}", FailureKind.FAILED)) for k in range(3, 6)] == [
        None,
        None,
        JobOutcome.TOO_MANY_FAILURES,
    ]


def test_draining_stops_the_long_task_and_lets_frames_finish():
    tasks = film(3)
    scheduler = begun(tasks)
    commit(scheduler, "simulate", "cache/0")
    assert scheduler.handle(DrainRequested()) == [Stop(TaskId("simulate"))]
    assert fail(scheduler, "simulate", FailureKind.CANCELLED) == []
    assert succeed(scheduler, tasks[1]) == [Finish(JobOutcome.DRAINED)]
    assert scheduler.state(TaskId("surface/0")) is TaskState.SUCCEEDED
    assert scheduler.state(TaskId("render/0")) is TaskState.CANCELLED


def test_a_drain_that_leaves_nothing_out_is_no_interruption():
    last = task("movie")
    scheduler = begun([last])
    scheduler.handle(DrainRequested())
    assert succeed(scheduler, last) == [Finish(JobOutcome.SUCCEEDED)]


def test_cancelling_kills_what_runs():
    scheduler = begun(film(1))
    scheduler.handle(DrainRequested())
    assert scheduler.handle(CancelRequested()) == [Kill(TaskId("simulate"))]
    assert outcome(fail(scheduler, "simulate", FailureKind.CANCELLED)) is JobOutcome.CANCELLED


def test_an_impossible_event_carries_the_history():
    scheduler = begun([task("a"), task("b", ("a.out",))])
    with pytest.raises(InvalidTransitionError, match=r"a: success without a\.out .* pending -> ready -> running"):
        scheduler.handle(finished("a"))
    with pytest.raises(InvalidTransitionError, match="b: worker lost cannot happen after pending") as caught:
        fail(scheduler, "b", FailureKind.WORKER_LOST)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(("first", "second"), [("b.out", "a.out"), ("nothing.h5", "a.out")])
def test_tasks_whose_inputs_will_never_come_are_named(first, second):
    with pytest.raises(ValueError, match="none of the others makes: a, b"):
        Scheduler([task("a", (first,)), task("b", (second,))], capacity=TWO_CORES).start()


@st.composite
def jobs(draw: st.DrawFn) -> list[Task]:
    """Layered random graphs with several outputs a task and varied needs."""
    tasks: list[Task] = []
    artifacts: list[str] = []
    for index in range(draw(st.integers(1, 14))):
        inputs = draw(st.lists(st.sampled_from(artifacts), max_size=3, unique=True)) if artifacts else []
        outputs = [f"{index}.{k}" for k in range(draw(st.integers(1, 3)))]
        resources = Resources(
            cores=draw(st.integers(0, 5)), memory_bytes=draw(st.integers(0, 4)), gpus=draw(st.integers(0, 1))
        )
        frame = draw(st.none() | st.integers(0, 5))
        name = f"s{draw(st.integers(0, 2))}/{index}"
        options = {"frame": frame, "resources": resources, "checkpointed": draw(st.booleans())}
        tasks.append(task(name, tuple(inputs), tuple(outputs), **options))
        artifacts += outputs
    return tasks


@settings(max_examples=200, deadline=None)
@given(jobs=jobs(), seed=st.integers(0, 2**32), faults=st.floats(0.0, 0.6), ending=st.floats(0.0, 0.05))
def test_random_events_never_break_an_invariant(jobs, seed, faults, ending):
    """Never overcommitted, no task twice at once, none before its inputs, and all ends in a terminal state."""
    chance = random.Random(seed)
    capacity = Resources(cores=3, memory_bytes=4, gpus=1)
    scheduler = Scheduler(jobs, capacity=capacity, policy=Policy(failure_count=3))
    by_id = {each.id: each for each in jobs}
    running: dict[TaskId, list[ArtifactPath]] = {}
    committed: set[ArtifactPath] = set()
    starts = dict.fromkeys(by_id, 0)
    now = 0.0
    instructions = scheduler.start()
    for _ in range(2000):
        for instruction in instructions:
            match instruction:
                case Start(one, threads, _):
                    assert one.id not in running
                    assert set(one.inputs) <= committed
                    assert 1 <= threads <= capacity.cores
                    starts[one.id] += 1
                    running[one.id] = [output for output in one.outputs if output not in committed]
                case Stop(task_id) | Kill(task_id):
                    assert task_id in running
        needs = [claim(by_id[task_id].resources, capacity) for task_id in running]
        total = Resources(*(sum(getattr(n, f) for n in needs) for f in ("cores", "memory_bytes", "gpus")))
        assert total.fits(capacity)
        assert sorted(scheduler.running) == sorted(running)
        if outcome(instructions) is not None:
            break
        if chance.random() < ending:
            instructions = scheduler.handle(chance.choice([DrainRequested(), CancelRequested()]))
            continue
        if not running:
            assert scheduler.next_wakeup is not None, "nothing runs, nothing waits, and no end"
            now = scheduler.next_wakeup
            instructions = scheduler.handle(Tick(now))
            continue
        task_id = chance.choice(sorted(running))
        if chance.random() < faults:
            del running[task_id]
            pauses = {FailureKind.DISK_FULL, FailureKind.OUTGROWN}
            kinds = [kind for kind in FailureKind if kind not in pauses or chance.random() < 0.1]
            instructions = fail(scheduler, task_id, chance.choice(kinds), now)
        elif running[task_id] and chance.random() < 0.2 and len(running[task_id]) == len(by_id[task_id].outputs):
            committed.update(running.pop(task_id))
            instructions = scheduler.handle(Skipped(task_id))
        elif running[task_id]:
            artifact = running[task_id].pop(0)
            committed.add(artifact)
            instructions = commit(scheduler, task_id, artifact)
        else:
            del running[task_id]
            instructions = scheduler.handle(finished(task_id))
    else:
        pytest.fail("no end after 2000 events")
    assert all(scheduler.state(task_id) in TERMINAL_STATES for task_id in by_id)
    assert all(count <= Policy().attempts for count in starts.values())
    assert sum(scheduler.counts().values()) == len(jobs)
