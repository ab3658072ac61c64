"""What a run puts on record: its attempts, each numbered before it starts, what they commit, and how they end."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, FailureKind, Resources, Task, TaskId, task_fingerprint
from pipeline.model.job import Job
from pipeline.record.manifest import Manifest, artifact_row
from pipeline.record.reader import ArtifactRow
from pipeline.run.events import Committed, Failed, Finished, Notice, Observer, TaskEvent, Warned
from pipeline.run.executors.attempt import load_stages
from pipeline.run.executors.base import Assignment
from pipeline.run.plan import input_hashes
from pipeline.run.scheduler import OWN_FAILURES
from pipeline.store.receipts import committed_receipt

_FORCED_ENDS = frozenset(FailureKind) - OWN_FAILURES - {FailureKind.DISK_FULL, FailureKind.OUTGROWN}
"""Ends that may come from outside, at any moment: between a commit and the word of it, too."""

_MEMORY = {FailureKind.OUT_OF_MEMORY, FailureKind.OUTGROWN}

Settled = Committed | Finished | Failed
"""What becomes of a task, as the scheduler takes it."""


@dataclass
class RunRecord:
    """The record of a run: keeps the manifest true to the executor's events, and passes on what the scheduler needs."""

    manifest: Manifest  # open for writing
    job: Job
    layout: JobLayout
    stages: str  # where the stages are, as `module:ATTRIBUTE`
    rows: dict[ArtifactPath, ArtifactRow]  # the artifacts that are valid; kept up to date
    notify: Observer  # gets commits that were adopted, and a notice of a full disk
    failures: dict[TaskId, Failed] = field(default_factory=dict)  # the last one of each task, in order
    parts_left: bool = False  # whether an attempt may have left a part file behind
    ended_by_force: bool = False  # whether an attempt ended in a way that may have swallowed the word of a commit
    _assignments: dict[TaskId, Assignment] = field(default_factory=dict)

    def invalidate(self, tasks: Iterable[Task]) -> None:
        """Drop the receipts of tasks that are to run again, so that their stage finds nothing to reuse.

        A file that was edited by hand keeps its receipt: that is how the commit knows to keep the edited one aside.
        """
        artifacts = [output for task in tasks for output in task.outputs if output in self.rows]
        for artifact in artifacts:
            self.layout.receipt(artifact).unlink(missing_ok=True)
            del self.rows[artifact]
        if artifacts:
            self.manifest.forget_artifacts(artifacts)

    def open_attempt(self, task: Task, *, threads: int, need: Resources) -> Assignment:
        """Number the next attempt of a task; it may begin when that is committed to the manifest."""
        attempt = self.manifest.start_attempt(task.id)
        inputs = input_hashes(task, self.rows)
        limits = self.job.limits_of(task.stage)
        self._assignments[task.id] = assignment = Assignment(
            task=task,
            attempt=attempt,
            fingerprint=task_fingerprint(task, inputs),
            inputs=inputs,
            threads=threads,
            job_file=self.layout.job_file.absolute(),  # wherever the worker's own folder is
            root=self.layout.root.absolute(),
            stages=self.stages,
            timeout_s=limits.timeout_s,
            stall_s=limits.stall_s,
            memory_bytes=limits.memory_bytes,
            need=need,
        )
        return assignment

    @property
    def begun(self) -> list[tuple[ArtifactPath, int]]:
        """Outputs of the attempts of this run, each with the number of the last one of its task."""
        return [(output, each.attempt) for each in self._assignments.values() for output in each.task.outputs]

    def take(self, event: TaskEvent, *, lacking: Callable[[TaskId], Sequence[ArtifactPath]]) -> list[Settled]:
        """Put an event of an attempt on record.

        Returns the events for the scheduler, in order: the same one, or what the files on disk show to have happened.
        `lacking` finds the outputs of a task whose commits the scheduler has not seen.
        """
        match event:
            case Committed():
                self._take_commit(event)
                return [event]
            case Warned(task_id, _, _, message):
                self.manifest.log_event("warning", message, task=task_id)
                return []
            case Finished():
                return self._take_end(event, lacking(event.task_id))
            case Failed():
                return self._take_failure(event, lacking(event.task_id))
            case _:
                return []

    def _take_commit(self, commit: Committed) -> None:
        self.manifest.record_artifact(commit.receipt)
        self.rows[commit.receipt.artifact] = artifact_row(commit.receipt)

    def _take_end(self, end: Finished, untold: Sequence[ArtifactPath]) -> list[Settled]:
        adopted, gone = self._adopt(end.task_id, untold)
        if gone:
            sentence = f"{gone[0]} was there when its task ended, and is not as it was committed any more"
            kind = FailureKind.FAILED
            failed = Failed(end.task_id, end.attempt, kind, sentence, "", end.seconds, end.peak_memory_bytes)
            return adopted + self._take_failure(failed, gone)
        self.manifest.finish_attempt(
            end.task_id, end.attempt, seconds=end.seconds, peak_memory_bytes=end.peak_memory_bytes
        )
        return [*adopted, end]

    def _take_failure(self, failed: Failed, untold: Sequence[ArtifactPath]) -> list[Settled]:
        if failed.kind in _MEMORY and (lighter := self._lighter(failed.task_id)):
            failed = replace(failed, message=f"{failed.message}; less is needed with {lighter}")
        # A process that was killed could not remove what it was writing, nor tell of its last commit.
        self.parts_left = True
        self.ended_by_force |= failed.kind in _FORCED_ENDS
        adopted, gone = self._adopt(failed.task_id, untold)
        succeeded = failed.kind in _FORCED_ENDS and not gone
        self.manifest.finish_attempt(
            failed.task_id,
            failed.attempt,
            failure=None if succeeded else failed.kind,
            message=f"after its last commit: {failed.message}" if succeeded else failed.message,
            seconds=failed.seconds,
            peak_memory_bytes=failed.peak_memory_bytes or None,
        )
        if succeeded:
            return [*adopted, Finished(failed.task_id, failed.attempt, failed.seconds, failed.peak_memory_bytes)]
        self.failures[failed.task_id] = failed
        if failed.kind is FailureKind.DISK_FULL:
            place = failed.full_place or self.layout.root
            sentence = f"the disk is full ({place}): the job pauses; free some space and submit it again"
            self.notify(Notice(sentence))
        if failed.kind is FailureKind.OUTGROWN:
            self.notify(Notice(f"{failed.message}: the job pauses"))
        return [*adopted, failed]

    def _lighter(self, task_id: TaskId) -> str:
        stage = self._assignments[task_id].task.stage
        return next(each.lighter(self.job) for each in load_stages(self.stages) if each.name == stage)

    def _adopt(self, task_id: TaskId, untold: Sequence[ArtifactPath]) -> tuple[list[Settled], list[ArtifactPath]]:
        """Take in outputs that are committed without the record knowing it: commits, and outputs that are not there.

        The stage found them there already, or its process was killed between a commit and the word of it.
        """
        assignment = self._assignments[task_id]
        commits: list[Settled] = []
        gone: list[ArtifactPath] = []
        for artifact in untold:
            receipt = committed_receipt(self.layout, artifact, assignment.fingerprint)
            if receipt is not None:
                commit = Committed(task_id, assignment.attempt, receipt)
                self.notify(commit)
                self._take_commit(commit)
                commits.append(commit)
            else:
                gone.append(artifact)
        return commits, gone
