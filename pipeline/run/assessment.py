"""How a job stands, held against its record and its files; changes nothing."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.model.job import Job
from pipeline.record.reader import ManifestReader, StageCost
from pipeline.record.reconcile import inspect_files
from pipeline.run.plan import Assessment, Verdict, assess, plan_job


class JobAssessment(NamedTuple):
    """How a job stands."""

    assessments: list[Assessment]  # what would run, and why
    costs: Mapping[str, StageCost]  # what the stages have taken so far
    at_rest: bool  # whether a run would find nothing to do or to put right, neither in the record nor in the files

    @property
    def current(self) -> frozenset[ArtifactPath]:
        """The files that are of the job as it is now; others may be there, of an earlier version of it."""
        return frozenset(
            output for each in self.assessments if each.verdict is Verdict.UP_TO_DATE for output in each.task.outputs
        )


def assess_job(job: Job, layout: JobLayout, until: Sequence[str] = ()) -> JobAssessment:
    """Hold a job that ends after the stages `until`, or with the film, against its record and its files."""
    from pipeline.stages import STAGES

    tasks = plan_job(job, layout, STAGES, until)
    if not layout.manifest.exists():
        return JobAssessment(assess(tasks, {}, {}, parameters=lambda _: None), {}, at_rest=False)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        rows = manifest.artifacts()
        found = inspect_files(layout, rows)
        assessments = assess(tasks, rows, found.problems, parameters=manifest.parameters)
        at_rest = (
            not (found.problems or found.new_mtimes_ns or found.newer_receipts)
            and all(each.verdict is Verdict.UP_TO_DATE for each in assessments)
            and manifest.is_at_rest(len(tasks))
        )
        return JobAssessment(assessments, dict(manifest.stage_costs()), at_rest)
