"""Stills: one frame of a job drawn with other settings, from what the job has computed, touching nothing of it.

A still is made in a scratch folder that looks like a job's: what the job has committed is linked into it with its
receipts, what is missing of that one frame is made there. So the job's record, its frames and a runner at work on it
see nothing of it.
"""

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replacing
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Resources, Task, task_fingerprint
from pipeline.job.loading import LoadedJob
from pipeline.run.executors.attempt import STAGES_REFERENCE, load_stages
from pipeline.run.plan import made_from, plan_job
from pipeline.run.single_stage import run_tasks
from pipeline.store.receipts import Receipt, committed_receipt
from render.temporary_folder import temporary_folder

SIMULATION = "simulate"


@dataclass(frozen=True, slots=True)
class Survey:
    """What frames can be drawn of."""

    committed: tuple[Receipt, ...]  # of what the job has of it
    todo: tuple[Task, ...]  # what can be made now, makers first; those that draw the frames are among them
    lacking: tuple[ArtifactPath, ...]  # frames of the simulation that are not there as this job has it


def survey(loaded: LoadedJob, layout: JobLayout, frames: Collection[int]) -> Survey:
    """What has to be made to draw frames of a submitted job, changed as the pictures are to be.

    Raises PipelineError: the job has no such frame.
    """
    job = loaded.job
    for frame in frames:
        if frame >= job.frame_count:
            raise PipelineError(f"{job.name} has no frame {frame}; its frames are 0-{job.frame_count - 1}")
    tasks = plan_job(job, layout, load_stages(STAGES_REFERENCE))
    pictures = {layout.picture(frame) for frame in frames}
    targets = {each.id for each in tasks if not pictures.isdisjoint(each.outputs)}
    needed = made_from(targets, tasks)
    read = {artifact for each in needed for artifact in each.inputs}
    receipts: dict[ArtifactPath, Receipt] = {}
    todo: list[Task] = []
    to_make: set[ArtifactPath] = set()
    lacking: list[ArtifactPath] = []
    for each in needed:
        wanted = [artifact for artifact in each.outputs if artifact in read]
        receipts.update({} if each.id in targets else _committed(each, wanted, layout, receipts))
        missing = [artifact for artifact in wanted if artifact not in receipts]
        if not missing and each.id not in targets:
            continue
        if each.stage == SIMULATION:
            lacking += missing
        elif all(artifact in receipts or artifact in to_make for artifact in each.inputs):
            todo.append(each)
            to_make.update(each.outputs)
    return Survey(tuple(receipts.values()), tuple(todo), tuple(lacking))


def make_still(
    loaded: LoadedJob,
    found: Survey,
    layout: JobLayout,
    target: Path,
    *,
    capacity: Resources,
    say: Callable[[str], None],
) -> None:
    """Make what is missing of a still, draw it, and put it into the target.

    `found` is what `survey` found for one frame; nothing of the simulation is lacking. `say` is called with the name of
    what begins. Raises PipelineError: it could not be made; says why.
    """
    with scratch_folder(loaded, found, layout) as scratch:
        for task in found.todo:
            say(task.id)

            def tell(_share: float, sentence: str, name: str = task.id) -> None:
                if sentence != name:
                    say(sentence)

            outcome = run_tasks(
                [task],
                scratch,
                capacity=capacity,
                tell=tell,
            )
            for failed in outcome.failures:
                raise PipelineError(f"{failed.task_id}: {failed.message}")
        for output in found.todo[-1].outputs:
            suffix = Path(output).suffix
            path = target if suffix == ".png" else target.with_suffix(suffix)  # an EXR lies beside its PNG
            with replacing(path) as part:
                shutil.copyfile(scratch.path(output), part)


@contextmanager
def scratch_folder(loaded: LoadedJob, found: Survey, layout: JobLayout) -> Iterator[JobLayout]:
    """A job's folder of its own, in which what is committed is there by link; gone at the end of the block."""
    with temporary_folder("still") as folder:
        scratch = JobLayout(folder.resolve())
        scratch.job_file.write_text(loaded.text, encoding="utf-8")
        for receipt in found.committed:
            path, copy = scratch.path(receipt.artifact), scratch.receipt(receipt.artifact)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(layout.path(receipt.artifact).resolve())
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(receipt.to_json(), encoding="utf-8")
        yield scratch


def _committed(
    task: Task, wanted: list[ArtifactPath], layout: JobLayout, receipts: Mapping[ArtifactPath, Receipt]
) -> dict[ArtifactPath, Receipt]:
    """Receipts of those wanted outputs that are there as this task would make them of the inputs that are there."""
    if any(artifact not in receipts for artifact in task.inputs):
        return {}
    fingerprint = task_fingerprint(task, {artifact: receipts[artifact].hash for artifact in task.inputs})
    found = {artifact: committed_receipt(layout, artifact, fingerprint) for artifact in wanted}
    return {artifact: receipt for artifact, receipt in found.items() if receipt is not None}
