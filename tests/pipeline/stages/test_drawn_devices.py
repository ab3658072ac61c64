"""Which device drew a frame is on record, and a film of several is warned of."""

import json
from pathlib import Path

import pytest
from command_line import pipeline
from numbered_frames import submitted

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.show.report.page import write_report
from pipeline.store.artifacts import committing
from pipeline.store.provenance import origins_of
from pipeline.store.receipts import Receipt

GPU = "OPTIX: NVIDIA H100"
WARNING = f"the film's frames were drawn by devices that round differently: 1 on CPU, 2 on {GPU}; "


def draw(layout: JobLayout, *devices: str) -> list[Receipt]:
    """Put a film on record, a picture and its master a frame, each by the device named."""
    tasks, receipts = [], []
    for frame, device in enumerate(devices):
        outputs = (layout.picture(frame), layout.master(frame))
        parameters = ParameterSet.of(stage="render", version=1, tools={})
        task = Task(TaskId(f"render/{frame:06d}"), "render", (), outputs, parameters, frame=frame)
        tasks.append(task)
        for output in outputs:
            with committing(
                layout, output, task=task, attempt=1, fingerprint="p", validate=lambda _: None, device=device
            ) as commit:
                commit.path.write_bytes(b"a picture")
            receipts.append(commit.receipt)
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("tank")
        manifest.record_plan(tasks, {task.id: TaskState.SUCCEEDED for task in tasks})
        manifest.record_artifacts(receipts)
        manifest.end_run()
    return receipts


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    return submitted(tmp_path / "tank")


@pytest.mark.parametrize(
    ("devices", "drawn_on"), [((GPU, GPU, "CPU"), {"CPU": 1, GPU: 2}), ((GPU, "", GPU), {GPU: 2})], ids=["two", "one"]
)
def test_a_film_of_two_devices_is_warned_of_where_its_state_is_asked(layout, devices, drawn_on):
    """Those that do not say what they are do not count."""
    draw(layout, *devices)
    status = pipeline("status", layout.root).stdout
    assert (f"  warning: {WARNING}pipeline explain" in status) == ("warning" in status) == (len(drawn_on) > 1)
    assert json.loads(pipeline("status", layout.root, "--json").stdout)["drawn_on"] == drawn_on


def test_frames_that_are_no_part_of_the_film_any_more_do_not_count(layout):
    draw(layout, "CPU", GPU)
    draw(layout, "CPU")
    with Manifest(layout.manifest) as manifest:
        assert manifest.devices("render") == {"CPU": 1}


@pytest.mark.parametrize("state", [TaskState.PENDING, TaskState.RUNNING, TaskState.FAILED])
def test_frames_that_are_about_to_be_replaced_do_not_count(layout, state):
    draw(layout, "CPU", GPU, "CPU")
    with Manifest(layout.manifest) as manifest:
        manifest.set_states({TaskId("render/000000"): state, TaskId("render/000002"): TaskState.UP_TO_DATE})
        assert manifest.devices("render") == {"CPU": 1, GPU: 1}


def test_the_report_tells_and_warns_too(layout):
    receipts = draw(layout, GPU, GPU, "CPU")
    for receipt in receipts:  # no pictures: the sheet has no use for them
        layout.receipt(receipt.artifact).unlink()
    write_report([layout], layout.report)
    text = layout.report.read_text()
    assert f"drawn on CPU, {GPU}</dd>" in text
    assert WARNING.replace("'", "&#x27;") in text


def test_the_story_of_a_frame_tells_what_drew_it(layout):
    (origin,) = origins_of(layout, draw(layout, GPU))
    assert f"        drawn on {GPU}" in list(origin.lines())
    assert origin.as_json()["device"] == GPU


def test_a_record_of_earlier_versions_is_brought_up_to_date(layout):
    receipts = draw(layout, "CPU")
    with Manifest(layout.manifest) as manifest:
        manifest._connection.executescript(
            "DROP INDEX artifact_by_device; ALTER TABLE artifact DROP COLUMN device; PRAGMA user_version = 2"
        )
    with Manifest(layout.manifest) as manifest:
        rows = manifest.artifacts()
    assert {artifact: row.device for artifact, row in rows.items()} == {
        ArtifactPath(receipt.artifact): "" for receipt in receipts
    }
