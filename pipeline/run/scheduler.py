"""The scheduler, which decides what task runs when: a pure state machine, `handle(event) -> [instruction]`.

It does no input or output and has no clock: its driver (the runner, or a test) feeds it events and carries out its
instructions. Tasks wait for artifacts, so each commit of a long task sets its readers free at once.

    PENDING --inputs committed--> READY --Start--> RUNNING --> SUCCEEDED | UP_TO_DATE | FAILED | CANCELLED
       |                            ^                 |
       |                            +--- machine's fault, attempts left (after a pause)
       +--an input will never come--> UPSTREAM_FAILED

Costs O(log n) an event plus the readers of what it committed, whatever the number of tasks.
"""

import heapq
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pipeline.base.errors import PipelineError
from pipeline.base.resources import claim, whole_machine
from pipeline.base.task import ArtifactPath, FailureKind, Policy, Resources, Task, TaskId, TaskState
from pipeline.run import events
from pipeline.run.packing import Packing, Priority

TERMINAL_STATES = frozenset(TaskState) - {TaskState.PENDING, TaskState.READY, TaskState.RUNNING}
_TRANSITIONS: Mapping[TaskState, Collection[TaskState]] = {
    TaskState.PENDING: {TaskState.READY, TaskState.UP_TO_DATE, TaskState.UPSTREAM_FAILED, TaskState.CANCELLED},
    TaskState.READY: {TaskState.RUNNING, TaskState.CANCELLED},
    TaskState.RUNNING: {TaskState.READY} | TERMINAL_STATES - {TaskState.UPSTREAM_FAILED},
}


class InvalidTransitionError(PipelineError):
    """An event that cannot happen in the task's state; its text has the states that the task went through."""


OWN_FAILURES = frozenset({FailureKind.FAILED, FailureKind.DIVERGED})
"""The task's own: it would fail the same way again."""
_PAUSES = {
    FailureKind.DISK_FULL: events.JobOutcome.DISK_FULL,
    FailureKind.OUTGROWN: events.JobOutcome.OUTGROWN,
}
"""Nothing is wrong with the task, and it goes on from where it is once there is room."""


@dataclass(slots=True)
class _Entry:
    task: Task
    need: Resources
    priority: Priority
    state: TaskState = TaskState.PENDING
    missing: int = 0
    failures: int = 0
    out_of_memory: int = 0
    history: list[TaskState] = field(default_factory=lambda: [TaskState.PENDING])

    def refuse(self, event: str) -> InvalidTransitionError:
        return InvalidTransitionError(f"{self.task.id}: {event} cannot happen after {' -> '.join(self.history)}")


class Scheduler:
    """Decides what runs next.

    Lower frames go first, or those whose turn is earlier, and of one frame the later stage, so that the film shows
    early and few intermediate files wait for their reader. Tasks about the whole job go before any frame, and of these
    the earlier stage.

    Args:
        tasks: all tasks of the job; stages in the order of their first task.
        up_to_date: tasks that need no run; their outputs count as committed.
        committed: further artifacts that are valid already, as those of a simulation that stopped half-way.
        capacity: what may be used at a time; `memory_bytes` 0 when memory is not to be counted.
        machine: the most that one task can be given, where `capacity` is that of several machines.
        policy: when tasks are tried again, and when the job gives up.
        policies: the same by stage, where it is another.
        turns: place of each frame in the order; None: as they are numbered.

    Raises ValueError: a task needs more GPUs than there are.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        *,
        up_to_date: Collection[TaskId] = frozenset(),
        committed: Iterable[ArtifactPath] = (),
        capacity: Resources,
        machine: Resources | None = None,
        policy: Policy | None = None,
        policies: Mapping[str, Policy] | None = None,
        turns: Sequence[int] | None = None,
    ) -> None:
        self._packing = Packing(machine=machine or capacity, capacity=capacity)
        self._policy = policy or Policy()
        self._policies = policies or {}
        self._committed = set(committed)
        self._entries: dict[TaskId, _Entry] = {}
        self._readers: defaultdict[ArtifactPath, list[_Entry]] = defaultdict(list)
        self._waiting: list[tuple[float, TaskId]] = []
        self._running: dict[TaskId, _Entry] = {}
        self._counts: Counter[tuple[str, TaskState]] = Counter()
        self._changes: list[events.StateChanged] = []
        self._now = 0.0
        self._ending: events.JobOutcome | None = None
        self._finished = False

        stages: dict[str, int] = {}
        for index, task in enumerate(tasks):
            rank = stages.setdefault(task.stage, len(stages))
            try:
                need = claim(task.resources, self._packing.machine)
            except ValueError as error:
                raise ValueError(f"{task.id} {error}") from None
            if task.frame is None:
                priority = (-1, rank, index)
            else:
                priority = (task.frame if turns is None else turns[task.frame], -rank, index)
            entry = _Entry(task, need, priority)
            self._entries[task.id] = entry
            self._counts[task.stage, TaskState.PENDING] += 1
            if task.id in up_to_date:
                self._committed.update(task.outputs)
        for entry in self._entries.values():
            if entry.task.id in up_to_date:
                self._set_state(entry, TaskState.UP_TO_DATE)
                continue
            for artifact in entry.task.inputs:
                if artifact not in self._committed:
                    entry.missing += 1
                    self._readers[artifact].append(entry)
            if entry.missing == 0:
                self._make_ready(entry)

    # --- what the driver asks ---

    @property
    def next_wakeup(self) -> float | None:
        """Monotonic time [s] at which a `Tick` will set a retry free, if one waits."""
        return self._waiting[0][0] if self._waiting and self._ending is None else None

    @property
    def running(self) -> list[TaskId]:
        """Tasks started and not ended."""
        return list(self._running)

    @property
    def free(self) -> Resources:
        """What no running task occupies."""
        return self._packing.free

    def state(self, task_id: TaskId) -> TaskState:
        """Where a task stands."""
        return self._entries[task_id].state

    def lacking(self, task_id: TaskId) -> list[ArtifactPath]:
        """Outputs of a task that are not committed."""
        return [artifact for artifact in self._entries[task_id].task.outputs if artifact not in self._committed]

    def counts(self) -> dict[tuple[str, TaskState], int]:
        """Number of tasks by stage and state."""
        return {key: count for key, count in self._counts.items() if count}

    def drain_changes(self) -> list[events.StateChanged]:
        """State changes since the last call, in order."""
        changes, self._changes = self._changes, []
        return changes

    # --- the machine ---

    def start(self) -> list[events.Instruction]:
        """The first instructions; call once, before any event."""
        return self._next_instructions()

    def handle(self, event: events.SchedulerEvent) -> list[events.Instruction]:
        """Take in what happened and say what to do. A failure happens at the time of the last `Tick`.

        Raises InvalidTransitionError: this cannot happen to a task in that state.
        """
        instructions: list[events.Instruction] = []
        match event:
            case events.Committed(task_id, _, receipt):
                entry = self._running_entry(task_id, f"commit of {receipt.artifact}")
                if receipt.artifact not in entry.task.outputs:
                    raise entry.refuse(f"commit of {receipt.artifact}, not its output,")
                self._commit(receipt.artifact)
            case events.Finished(task_id):
                entry = self._running_entry(task_id, "success")
                if lacking := self.lacking(task_id):
                    raise entry.refuse(f"success without {lacking[0]}")
                self._end(entry, TaskState.SUCCEEDED)
            case events.Skipped(task_id):
                entry = self._running_entry(task_id, "skip")
                for artifact in entry.task.outputs:
                    self._commit(artifact)
                self._end(entry, TaskState.UP_TO_DATE)
            case events.Failed(task_id, _, kind):
                instructions += self._fail(self._running_entry(task_id, kind), kind)
            case events.CapacityChanged() | events.GpuWithdrawn():
                instructions += self._resize(event)
            case events.DrainRequested():
                instructions += self._drain(events.JobOutcome.DRAINED)
            case events.CancelRequested():
                self._ending = events.JobOutcome.CANCELLED
                instructions += [events.Kill(task_id) for task_id in self._running]
            case events.Tick(now):
                self._now = now
                while self._waiting and self._waiting[0][0] <= now:
                    _, task_id = heapq.heappop(self._waiting)
                    self._enqueue(self._entries[task_id])
        return instructions + self._next_instructions()

    def _resize(self, event: events.CapacityChanged | events.GpuWithdrawn) -> list[events.Instruction]:
        if isinstance(event, events.CapacityChanged):
            self._packing.resize(event.capacity)
            return []
        self._packing.keep_gpus(event.left)
        return [] if event.left else self._drain(events.JobOutcome.NO_GPU)

    # --- transitions ---

    def _running_entry(self, task_id: TaskId, event: str) -> _Entry:
        entry = self._entries[task_id]
        if entry.state is not TaskState.RUNNING:
            raise entry.refuse(event)
        return entry

    def _set_state(self, entry: _Entry, state: TaskState) -> None:
        if state not in _TRANSITIONS.get(entry.state, ()):
            raise entry.refuse(f"becoming {state}")
        self._counts[entry.task.stage, entry.state] -= 1
        self._counts[entry.task.stage, state] += 1
        entry.state = state
        entry.history.append(state)
        self._changes.append(events.StateChanged(entry.task.id, entry.task.stage, state))

    def _make_ready(self, entry: _Entry) -> None:
        self._set_state(entry, TaskState.READY)
        self._enqueue(entry)

    def _enqueue(self, entry: _Entry) -> None:
        self._packing.add(entry.task.id, need=entry.need, priority=entry.priority)

    def _commit(self, artifact: ArtifactPath) -> None:
        if artifact in self._committed:
            return
        self._committed.add(artifact)
        for reader in self._readers.pop(artifact, ()):
            reader.missing -= 1
            if reader.missing == 0 and reader.state is TaskState.PENDING:
                self._make_ready(reader)

    def _release(self, entry: _Entry) -> None:
        del self._running[entry.task.id]
        self._packing.give_back(entry.task.id, entry.need)

    def _end(self, entry: _Entry, state: TaskState) -> None:
        self._release(entry)
        self._set_state(entry, state)
        if state in {TaskState.FAILED, TaskState.CANCELLED}:
            self._give_up_readers_of(entry, TaskState.UPSTREAM_FAILED if state is TaskState.FAILED else state)

    def _give_up_readers_of(self, entry: _Entry, state: TaskState) -> None:
        """Descendants that wait for something this task will not make any more."""
        lost = self.lacking(entry.task.id)
        while lost:
            for reader in self._readers.pop(lost.pop(), ()):
                if reader.state is TaskState.PENDING:
                    self._set_state(reader, state)
                    lost += self.lacking(reader.task.id)

    def _fail(self, entry: _Entry, kind: FailureKind) -> list[events.Instruction]:
        if kind in OWN_FAILURES:
            return self._fail_for_good(entry)
        if kind in _PAUSES:
            self._end(entry, TaskState.CANCELLED)
            return self._drain(_PAUSES[kind])
        if kind is FailureKind.CANCELLED and self._ending is not None:
            self._end(entry, TaskState.CANCELLED)
            return []
        # The machine's fault; a task stopped by somebody else than us counts as that, too.
        entry.failures += 1
        policy = self._policy_of(entry.task.stage)
        out_of_memory = kind is FailureKind.OUT_OF_MEMORY
        entry.out_of_memory += out_of_memory
        # Want of memory is counted apart: a lost worker before it does not cost the task its turn alone on the machine.
        if entry.out_of_memory >= policy.out_of_memory_attempts or entry.failures >= policy.attempts:
            return self._fail_for_good(entry)
        self._release(entry)
        self._set_state(entry, TaskState.READY)
        if out_of_memory:
            entry.need = whole_machine(entry.need, self._packing.machine)
        pause = policy.backoff_s * 2.0 ** (entry.failures - 1)
        heapq.heappush(self._waiting, (self._now + pause, entry.task.id))
        return []

    def _fail_for_good(self, entry: _Entry) -> list[events.Instruction]:
        self._end(entry, TaskState.FAILED)
        stage = entry.task.stage
        failed = self._counts[stage, TaskState.FAILED]
        ended = failed + self._counts[stage, TaskState.SUCCEEDED]
        policy = self._policy_of(stage)
        if failed >= policy.failure_count and failed >= policy.failure_share * ended:
            return self._drain(events.JobOutcome.TOO_MANY_FAILURES)
        return []

    def _policy_of(self, stage: str) -> Policy:
        return self._policies.get(stage, self._policy)

    def _drain(self, outcome: events.JobOutcome) -> list[events.Instruction]:
        if self._ending is not None:
            return []
        self._ending = outcome
        return [events.Stop(task_id) for task_id, entry in self._running.items() if entry.task.checkpointed]

    # --- what follows ---

    def _next_instructions(self) -> list[events.Instruction]:
        instructions: list[events.Instruction] = []
        if self._ending is None:
            while (task_id := self._packing.take()) is not None:
                instructions.append(self._start(self._entries[task_id]))
        startable = bool(self._waiting) or self._packing.has_ready
        if not self._running and not self._finished and (self._ending is not None or not startable):
            self._finished = True
            instructions.append(events.Finish(self._close()))
        return instructions

    def _start(self, entry: _Entry) -> events.Start:
        self._set_state(entry, TaskState.RUNNING)
        self._running[entry.task.id] = entry
        threads = claim(entry.task.resources, self._packing.machine).cores
        return events.Start(entry.task, threads=threads, need=entry.need)

    def _close(self) -> events.JobOutcome:
        """Settle what never ran, and say how the job ended."""
        unsettled = [entry for entry in self._entries.values() if entry.state not in TERMINAL_STATES]
        if unsettled and self._ending is None:
            names = ", ".join(entry.task.id for entry in unsettled[:3])
            raise ValueError(f"tasks wait for what none of the others makes: {names}")
        for entry in unsettled:
            self._set_state(entry, TaskState.CANCELLED)
        states = {state for _, state in self.counts()}
        if self._ending is not None and TaskState.CANCELLED in states:
            return self._ending
        # Also when the end was asked for while the last task ran: nothing was left out.
        return events.JobOutcome.FAILED if TaskState.FAILED in states else events.JobOutcome.SUCCEEDED
