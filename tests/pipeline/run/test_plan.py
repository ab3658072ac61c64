import dataclasses
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_samples import film, parameter_set

from pipeline.base.errors import PlanError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task, TaskId, task_fingerprint
from pipeline.model.job import Job
from pipeline.record.manifest import artifact_row
from pipeline.record.reader import ArtifactRow
from pipeline.record.reconcile import FileCondition, FileProblem
from pipeline.run.plan import (
    Assessment,
    Verdict,
    assess,
    frame_ranges,
    in_order,
    plan_job,
    summarize,
    up_to_date,
)
from pipeline.stages import STAGES
from pipeline.store.receipts import Receipt

FRAMES = 6
CACHE_2 = ArtifactPath("cache/000002.h5")
PICTURE_2 = ArtifactPath("frames/000002.png")


def rows_of(tasks: list[Task]) -> dict[ArtifactPath, ArtifactRow]:
    """The record after every task has run."""
    rows: dict[ArtifactPath, ArtifactRow] = {}
    for task in tasks:
        inputs = {path: rows[path].hash for path in task.inputs}
        for output in task.outputs:
            fingerprint = task_fingerprint(task, inputs)
            receipt = Receipt(
                artifact=output,
                task=task.id,
                stage=task.stage,
                attempt=1,
                fingerprint=fingerprint,
                parameters=task.parameters.digest,
                size=1,
                mtime_ns=1,
                hash=f"hash of {output} from {fingerprint}",
                inputs=inputs,
            )
            rows[output] = artifact_row(receipt)
    return rows


def assess_film(
    tasks: list[Task],
    rows: dict[ArtifactPath, ArtifactRow],
    problems: dict[ArtifactPath, FileProblem] | None = None,
    forced: frozenset[TaskId] = frozenset(),
) -> dict[TaskId, Assessment]:
    sets = {task.parameters.digest: task.parameters for task in film(1)}
    found = assess(tasks, rows, problems or {}, parameters=sets.get, forced=forced)
    return {assessment.task.id: assessment for assessment in found}


def with_verdict(assessments: dict[TaskId, Assessment], verdict: Verdict) -> list[str]:
    return [task for task, assessment in assessments.items() if assessment.verdict is verdict]


def test_nothing_is_up_to_date_at_first():
    assessments = assess_film(film(2), {})
    assert with_verdict(assessments, Verdict.STALE) == ["simulate", "render/000000", "render/000001", "film"]
    assert summarize(assessments.values()) == [
        "simulate: stale, never made",
        "render 0-1: stale, never made",
        "film: stale, never made",
    ]


def test_a_finished_film_is_up_to_date():
    tasks = film(FRAMES)
    rows = rows_of(tasks)
    assessments = assess_film(tasks, rows)
    assert {assessment.verdict for assessment in assessments.values()} == {Verdict.UP_TO_DATE}
    assert all(up_to_date(task, rows) for task in tasks)
    assert summarize(assessments.values()) == ["simulate: up to date", "render 0-5: up to date", "film: up to date"]


def test_a_new_camera_reruns_frames_and_film_only_and_is_named():
    assessments = assess_film(film(FRAMES, camera=(0, -4, 2)), rows_of(film(FRAMES)))
    assert summarize(assessments.values()) == [
        "simulate: up to date",
        "render 0-5: stale, camera.position changed from [0, -5, 2] to [0, -4, 2]",
        "film: runs if its inputs turn out different, frames/ will be made anew",
    ]


def test_a_new_viscosity_reruns_the_simulation_and_perhaps_the_rest():
    assessments = assess_film(film(2, viscosity=2.0), rows_of(film(2)))
    assert with_verdict(assessments, Verdict.STALE) == ["simulate"]
    assert with_verdict(assessments, Verdict.DOWNSTREAM) == ["render/000000", "render/000001", "film"]
    assert assessments[TaskId("simulate")].reasons[0].text == "fluid[water].viscosity changed from 1.0 to 2.0"
    assert assessments[TaskId("render/000001")].reasons[0].text == "cache/000001.h5 will be made anew"


def test_parameters_that_the_record_has_lost_are_told_as_such():
    found = assess(film(1, viscosity=2.0), rows_of(film(1)), {}, parameters=lambda _: None)
    assert found[0].reasons[0].text == "its parameters changed; what they were is not on record"


def test_a_longer_film_continues_the_simulation_and_keeps_every_frame():
    assessments = assess_film(film(FRAMES), rows_of(film(4)))
    simulate = assessments[TaskId("simulate")]
    assert simulate.rebuilds == ("cache/000004.h5", "cache/000005.h5")
    assert simulate.reasons[0].text == "2 of 6 files: never made"
    assert with_verdict(assessments, Verdict.UP_TO_DATE) == [f"render/{k:06d}" for k in range(4)]
    assert with_verdict(assessments, Verdict.STALE) == ["simulate", "render/000004", "render/000005", "film"]
    (reason,) = assessments[TaskId("film")].reasons
    assert reason.text == "frames/000004.png is a new input, and 1 more like it"


def test_a_shorter_film_reruns_only_what_is_made_of_all_frames():
    assessments = assess_film(film(4), rows_of(film(FRAMES)))
    assert with_verdict(assessments, Verdict.STALE) == ["film"]
    (reason,) = assessments[TaskId("film")].reasons
    assert reason.text == "frames/000004.png is no input any more, and 1 more like it"


@pytest.mark.parametrize("condition", list(FileCondition))
def test_a_file_that_does_not_count_reruns_its_task_and_perhaps_those_after_it(condition):
    tasks = film(FRAMES)
    problems = {CACHE_2: FileProblem(condition, "what was found")}
    assessments = assess_film(tasks, rows_of(tasks), problems)
    assert assessments[TaskId("simulate")].rebuilds == (CACHE_2,)
    assert assessments[TaskId("simulate")].reasons[0].text == f"{CACHE_2}: what was found"
    assert with_verdict(assessments, Verdict.STALE) == ["simulate"]
    assert with_verdict(assessments, Verdict.DOWNSTREAM) == ["render/000002", "film"]


def test_a_changed_input_is_named_although_its_maker_is_up_to_date():
    tasks = film(FRAMES)
    rows = rows_of(tasks)
    rows[PICTURE_2] = rows[PICTURE_2]._replace(hash="another")
    assessments = assess_film(tasks, rows)
    assert with_verdict(assessments, Verdict.STALE) == ["film"]
    assert assessments[TaskId("film")].reasons[0].text == "frames/000002.png changed"
    rows[ArtifactPath("movie.mp4")] = rows[ArtifactPath("movie.mp4")]._replace(inputs="{}")
    assert assess_film(tasks, rows)[TaskId("film")].reasons[0].text == "its inputs changed"


def test_the_same_content_made_anew_stops_the_rerun():
    """Early cutoff: the rebuilt cache file has the old hash, so its picture is up to date at dispatch."""
    tasks = film(FRAMES)
    rows = rows_of(tasks)
    render = next(task for task in tasks if task.outputs == (PICTURE_2,))
    rows[CACHE_2] = rows[CACHE_2]._replace(attempt=2, mtime_ns=99)
    assert up_to_date(render, rows)
    rows[CACHE_2] = rows[CACHE_2]._replace(hash="another")
    assert not up_to_date(render, rows)
    del rows[PICTURE_2]
    assert not up_to_date(render, rows)


def test_forced_tasks_run_whatever_the_record_says():
    tasks = film(2)
    assessments = assess_film(tasks, rows_of(tasks), forced=frozenset({TaskId("render/000001")}))
    assert with_verdict(assessments, Verdict.STALE) == ["render/000001"]
    assert with_verdict(assessments, Verdict.DOWNSTREAM) == ["film"]
    assert "render 1: stale, to be run again, as asked" in summarize(assessments.values())


@settings(deadline=None)
@given(data=st.data())
def test_whatever_is_damaged_all_that_depends_on_it_and_nothing_else_may_run(data):
    tasks = film(4)
    rows = rows_of(tasks)
    lost = data.draw(st.sets(st.sampled_from(sorted(rows))))
    unsound = data.draw(st.sets(st.sampled_from(sorted(rows))))
    problems = {path: FileProblem(FileCondition.MISSING, "file is missing") for path in unsound}
    assessments = assess_film(tasks, {path: row for path, row in rows.items() if path not in lost}, problems)
    bad = lost | unsound
    affected = set(bad)
    for task in tasks:
        direct = bad.intersection(task.outputs)
        upstream = affected.intersection(task.inputs)
        assessment = assessments[task.id]
        expected = Verdict.STALE if direct else Verdict.DOWNSTREAM if upstream else Verdict.UP_TO_DATE
        assert assessment.verdict is expected
        assert bool(assessment.reasons) == (expected is not Verdict.UP_TO_DATE)
        if direct or upstream:
            assert set(assessment.rebuilds) == (direct if task.checkpointed else set(task.outputs))
            affected.update(assessment.rebuilds)


@pytest.mark.parametrize(
    ("frames", "planned", "text"),
    [
        ({0, 1, 2, 4}, range(6), "0-2, 4"),
        ({0, 30, 60}, range(0, 120, 30), "0-60"),
        ({0, 60}, range(0, 120, 30), "0, 60"),
        ({7}, range(6, 9), "7"),
    ],
)
def test_frames_are_named_in_ranges_over_the_frames_that_are_planned(frames, planned, text):
    assert frame_ranges(frames, planned) == text


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_makers_come_before_users_in_whatever_order_stages_plan_them(seed):
    tasks = film(FRAMES)
    random.Random(seed).shuffle(tasks)
    ordered = in_order(tasks)
    assert sorted(task.id for task in ordered) == sorted(task.id for task in tasks)
    made: set[ArtifactPath] = set()
    for task in ordered:
        assert made.issuperset(task.inputs)
        made.update(task.outputs)


def test_tasks_that_do_not_fit_together_are_refused():
    simulate, render, movie = film(1)
    with pytest.raises(PlanError, match="two tasks are called simulate"):
        in_order([simulate, simulate])
    with pytest.raises(PlanError, match=r"cache/000000.h5 is made by two tasks, simulate and again"):
        in_order([simulate, dataclasses.replace(simulate, id=TaskId("again"))])
    with pytest.raises(PlanError, match=r"film reads frames/000000.png, which no task makes"):
        in_order([simulate, movie])
    circle = Task(TaskId("circle"), "s", movie.outputs, simulate.outputs, parameter_set("s"))
    with pytest.raises(PlanError, match=r"in a circle: .*circle"):
        in_order([circle, render, movie])


def test_the_real_stages_fit_together(tmp_path):
    fluid = {"name": "water", "block": [{"shape": {"type": "box", "size": [0.2, 0.2, 0.2]}}]}
    job = Job.model_validate({"name": "drop", "frames": 3, "fluid": [fluid]})
    tasks = plan_job(job, JobLayout(tmp_path), STAGES)
    assert tasks[-1].outputs == (JobLayout.movie(),)
    assert {JobLayout.frame_cache(2), JobLayout.surface("water", 2), JobLayout.picture(2)} <= {
        output for task in tasks for output in task.outputs
    }
    assert list(tmp_path.iterdir()) == []  # planning touches no file
