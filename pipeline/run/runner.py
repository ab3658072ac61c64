"""Running a job: the loop between scheduler, executor and manifest.

    lease -> manifest -> reconcile -> plan, assess -> [ executor's events -> record -> scheduler -> start ] -> outcome

Killed at any point, it leaves a folder that the next run continues from: what is committed has its receipt, the workers
die with it, and the lease of a dead process counts for nothing.
"""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from pipeline.base.errors import DamagedManifestError, DiskFullError, LeaseLostError, PlanError
from pipeline.base.files import holds, replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.places import check_places
from pipeline.base.resources import machine_capacity
from pipeline.base.task import ArtifactPath, Policy, Resources, Task, TaskId, TaskState
from pipeline.base.wording import counted
from pipeline.model.job import Job
from pipeline.record.manifest import Manifest, move_out_of_reach
from pipeline.record.reconcile import Reconciliation, rebuild_manifest, reconcile
from pipeline.run import events
from pipeline.run.bookkeeping import RunRecord
from pipeline.run.control import RunControl, Selection
from pipeline.run.executors.attempt import STAGES_REFERENCE, load_stages
from pipeline.run.executors.base import Assignment, Executor
from pipeline.run.executors.failures import is_disk_full
from pipeline.run.goal import write_goal
from pipeline.run.plan import Assessment, Verdict, assess, frame_turns, plan_job, up_to_date
from pipeline.run.scheduler import Scheduler
from pipeline.run.sharing import Shared, take_over_shared
from pipeline.store.artifacts import remove_parts_of, sweep_parts
from render.temporary_folder import remove_folders_of_the_dead

_TURN_S = 0.25
"""Longest time that the loop sleeps [s]; so soon it answers Ctrl-C."""
_STOP_GRACE_S = 120.0
"""Time a long task gets to write its checkpoint when the run is drained [s]."""


def run_job(
    job: Job,
    layout: JobLayout,
    *,
    executor: Executor,
    job_text: str | None = None,
    stages: str = STAGES_REFERENCE,
    observers: Sequence[events.Observer] = (),
    control: RunControl | None = None,
    rerun: Selection | None = None,
    until: Sequence[str] = (),
    capacity: Resources | None = None,
    machine: Resources | None = None,
    policy: Policy | None = None,
) -> events.Outcome:
    """Run a job until nothing is left to do, or somebody stops it.

    Args:
        layout: its folder; made if it is not there.
        executor: runs the tasks; shut down by the caller.
        job_text: the job file, kept in the folder for the workers; None: it is there already.
        stages: where the stages are, as `module:ATTRIBUTE`.
        observers: get every event of the run.
        control: how the caller stops the run; SIGINT and SIGTERM do in any case.
        rerun: tasks to run again although they are up to date.
        until: the stages after which it ends, kept in the folder; empty: the film.
        capacity: what tasks may use at a time; this machine by default.
        machine: the most that one task can be given, where `capacity` is that of several machines.
        policy: when failed tasks are tried again, and when the job gives up; a stage's own limits come first.

    Raises:
        FolderGoneError: the job's folder was renamed or removed meanwhile.
        JobBusyError: another live process runs this job.
        LeaseLostError: another process took the job over, because this one did not answer for long.
        ManifestError: the record cannot be used; the text says what to do. One that is damaged is made anew.
        PipelineError: something is in the place of a file or a folder of the job.
        PlanError: the stages' tasks do not fit together, or `rerun` names what is not there.
    """

    def notify(event: events.RunEvent) -> None:
        for observer in observers:
            observer(event)

    control = control or RunControl()
    policy = policy or Policy()
    began = time.monotonic()
    remove_folders_of_the_dead()
    layout.root.mkdir(parents=True, exist_ok=True)
    check_places(layout)
    with Lease.acquire(layout.lease) as lease, control.on_signals():
        begin = partial(_begin, job, layout, lease, job_text=job_text, stages=stages, rerun=rerun, until=until)
        try:
            manifest, tasks, forced, reconciliation = begin()
        except DamagedManifestError:
            notify(events.Notice(_made_anew(layout)))
            manifest, tasks, forced, reconciliation = begin()
        with manifest:
            for sentence in (lease.takeover, *reconciliation.sentences):
                if sentence is not None:
                    notify(events.Notice(sentence))
            assessments = assess(
                tasks, reconciliation.rows, reconciliation.problems, parameters=manifest.parameters, forced=forced
            )
            notify(events.RunStarted(assessments))
            lease.check()
            record = RunRecord(manifest, job, layout, stages, reconciliation.valid_rows, notify)
            record.invalidate(task for task in tasks if task.id in forced)
            try:
                scheduler = Scheduler(
                    tasks,
                    up_to_date={each.task.id for each in assessments if each.verdict is Verdict.UP_TO_DATE},
                    committed=_kept(assessments),
                    capacity=capacity or machine_capacity(gpus=max((task.resources.gpus for task in tasks), default=0)),
                    machine=machine,
                    policy=policy,
                    policies={stage: limits.policy(policy) for stage, limits in job.limits.items()},
                    turns=frame_turns(job),
                )
            except ValueError as error:  # a GPU that is nowhere, for instance
                raise PlanError(str(error)) from error
            scheduler.drain_changes()  # the initial states are recorded as a whole
            manifest.record_plan(tasks, {task.id: scheduler.state(task.id) for task in tasks})
            run = _Run(layout, lease, manifest, executor, notify, control, forced, record, scheduler)
            outcome = run.outcome(run.loop(), time.monotonic() - began)
    notify(events.RunEnded(outcome))
    return outcome


def _begin(
    job: Job,
    layout: JobLayout,
    lease: Lease,
    *,
    job_text: str | None,
    stages: str,
    rerun: Selection | None,
    until: Sequence[str],
) -> tuple[Manifest, list[Task], frozenset[TaskId], Reconciliation]:
    """The record, marked as being run; the tasks, those of them that are forced, and how record and files agree."""
    if lease.takeover is not None:
        move_out_of_reach(layout.manifest)
    manifest = Manifest(layout.manifest)
    try:
        if job_text is not None:
            _write_job_file(layout, job_text)
        # What is refused here was no run: the record goes on saying how the last one ended.
        tasks = plan_job(job, layout, load_stages(stages), until)
        check_places(layout, (artifact for task in tasks for artifact in task.outputs))
        forced = frozenset[TaskId]() if rerun is None else rerun.of(tasks)
        write_goal(layout, until)
        clean = manifest.begin_run(job.name, run=lease.holder.token)
        if lease.takeover is not None:
            manifest.log_event("takeover", lease.takeover)
        shared = take_over_shared(layout, [task for task in tasks if task.id not in forced])
        return manifest, tasks, forced, _agreed(manifest, layout, shared, clean=clean)
    except BaseException:
        manifest.close()
        raise


def _agreed(manifest: Manifest, layout: JobLayout, shared: Shared, *, clean: bool) -> Reconciliation:
    """Record and files brought together, those that were taken over among them."""
    reconciliation = reconcile(manifest, layout, clean=clean and not shared.files)
    if not shared.files:
        return reconciliation
    manifest.log_event("shared", str(shared))
    return replace(reconciliation, sentences=(str(shared), *reconciliation.sentences))


def _made_anew(layout: JobLayout) -> str:
    """Make a new record of the receipts in place of a damaged one; returns what to tell of it."""
    aside, count = rebuild_manifest(layout)
    return f"{layout.manifest} was damaged and is made anew of {counted(count, 'receipt')}; the old one is {aside}"


def _kept(assessments: Sequence[Assessment]) -> set[ArtifactPath]:
    """What long tasks have committed of their present fingerprint: it stays, and its readers need not wait for it."""
    return {
        artifact
        for each in assessments
        if each.task.checkpointed and each.verdict is Verdict.STALE
        for artifact in set(each.task.outputs) - set(each.rebuilds)
    }


@dataclass
class _Run:
    """One run of a job, holding its lease and its manifest."""

    layout: JobLayout
    lease: Lease
    manifest: Manifest
    executor: Executor
    notify: events.Observer
    control: RunControl
    forced: frozenset[TaskId]
    record: RunRecord
    scheduler: Scheduler
    obeyed: int = 0
    ending: events.JobOutcome | None = None

    def loop(self) -> events.JobOutcome:
        """Run until the scheduler says that it is over."""
        try:
            self._turn([], self.scheduler.start())
            while self.ending is None:
                news = self.executor.wait(self._sleep_s())
                self.lease.check()
                if any(isinstance(event, events.Failed) for event in news):
                    self.lease.look()
                self._turn(news, self._obey_control() + self.scheduler.handle(events.Tick(time.monotonic())))
            if self.record.parts_left:
                sweep_parts(self.layout)
            self.manifest.end_run(self.ending, clean=not self.record.ended_by_force)
        except LeaseLostError:
            self.executor.shutdown()
            remove_parts_of(self.layout, self.record.begun)
            raise
        except OSError as error:
            if not is_disk_full(error):
                raise
            # Our own record could not be written. The receipts can tell all of it, so nothing is lost; the run does
            # not count as ended cleanly, and the next one reads them.
            self.executor.shutdown()
            self.notify(events.Notice(str(DiskFullError.of(self.layout.root))))
            return events.JobOutcome.DISK_FULL
        return self.ending

    def outcome(self, kind: events.JobOutcome, seconds: float) -> events.Outcome:
        """The run in figures."""
        counts = self.scheduler.counts()
        return events.Outcome(
            kind=kind,
            ran=sum(count for (_, state), count in counts.items() if state is TaskState.SUCCEEDED),
            failures=tuple(
                failed
                for task_id, failed in self.record.failures.items()
                if self.scheduler.state(task_id) is TaskState.FAILED
            ),
            counts=counts,
            seconds=seconds,
            full_place=next((failed.full_place for failed in self.record.failures.values() if failed.full_place), ""),
        )

    # --- one turn ---

    def _sleep_s(self) -> float:
        wakeup = self.scheduler.next_wakeup
        return _TURN_S if wakeup is None else min(_TURN_S, max(0.0, wakeup - time.monotonic()))

    def _obey_control(self) -> list[events.Instruction]:
        instructions: list[events.Instruction] = []
        while self.obeyed < min(2, self.control.interruptions):
            self.obeyed += 1
            if self.obeyed == 1:
                self.notify(events.Notice("stopping: what runs is finished or checkpointed; once more stops at once"))
                instructions += self.scheduler.handle(events.DrainRequested())
            else:
                self.notify(events.Notice("stopping at once"))
                instructions += self.scheduler.handle(events.CancelRequested())
        return instructions

    def _turn(self, news: Sequence[events.ExecutorEvent], instructions: Sequence[events.Instruction]) -> None:
        """Take in what happened, in one commit to the manifest, and do what follows from it.

        The commit is not synced to the disk, which would cost a task more than everything else here: a killed process
        loses nothing by that, and after a power cut the receipts tell what is missing, for those are synced. Attempts
        are given out only when their numbers are on record, so that no number is used twice.
        """
        if not news and not instructions:
            return
        todo = deque(instructions)
        assignments: list[Assignment] = []
        cancellations: list[tuple[TaskId, float]] = []
        with self.manifest.transaction(durable=False):
            for event in news:
                todo += self._take(event)
            while todo:
                match todo.popleft():
                    case events.Start(task, threads, need):
                        # Early cutoff: what was made anew upstream may have turned out the same.
                        if task.id not in self.forced and up_to_date(task, self.record.rows):
                            todo += self.scheduler.handle(events.Skipped(task.id))
                        else:
                            assignments.append(self.record.open_attempt(task, threads=threads, need=need))
                    case events.Stop(task_id):
                        cancellations.append((task_id, _STOP_GRACE_S))
                    case events.Kill(task_id):
                        cancellations.append((task_id, 0.0))
                    case events.Finish(outcome):
                        self.ending = outcome
            self._note_states()
        for assignment in assignments:
            self.executor.submit(assignment)
        for task_id, grace_s in cancellations:
            self.executor.cancel(task_id, grace_s=grace_s)

    def _take(self, event: events.ExecutorEvent) -> list[events.Instruction]:
        if isinstance(event, events.CapacityChanged | events.GpuWithdrawn):
            if isinstance(event, events.GpuWithdrawn):
                self.manifest.log_event("gpu", event.message)
                self.notify(events.Notice(event.message))
            return self.scheduler.handle(event)
        self.notify(event)
        settled = self.record.take(event, lacking=self.scheduler.lacking)
        return [instruction for each in settled for instruction in self.scheduler.handle(each)]

    def _note_states(self) -> None:
        latest = {change.task_id: change for change in self.scheduler.drain_changes()}
        if latest:
            self.manifest.set_states({task_id: change.state for task_id, change in latest.items()})
            for change in latest.values():
                self.notify(change)


def _write_job_file(layout: JobLayout, text: str) -> None:
    """Replace the job's own copy of its file, at once as a whole; left alone if nothing changed."""
    if not holds(layout.job_file, text):
        replace_durably(layout.job_file, text)
