"""Saved jobs and recordings of a session, whose frames later stages find."""

import errno
import json
import shlex
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from checked_jobs import load_checked_job
from command_line import pipeline
from live_jobs import BALL_OVER_SHEET, live, loaded, recording

from pipeline.base.errors import JobBusyError, LeaseLostError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.resources import machine_capacity
from pipeline.job.loading import load_job, read_job
from pipeline.queue.changes import continuation
from pipeline.queue.job_queue import JobQueue
from pipeline.record.interrupted_recording import complete_interrupted_recording, frames_of_interrupted_recording
from pipeline.run.single_stage import StageOutcome, run_stage
from pipeline.store.cache import read_frame
from pipeline.web.dashboard.actions import Queue, actions_of
from pipeline.web.dashboard.farm_view import FarmView
from pipeline.web.dashboard.places import Places
from pipeline.web.live.admission import live_job
from pipeline.web.live.recording import Recorder
from pipeline.web.live.requests import CannotGoOnError
from pipeline.web.live.saving import save_job
from pipeline.web.live.session import Session

pytestmark = pytest.mark.usefixtures("taichi")


def stage_run(layout: JobLayout, stage: str) -> StageOutcome:
    """One stage of a recording's job, run."""
    return run_stage(
        load_job(layout.job_file),
        layout,
        stage,
        capacity=machine_capacity(),
        stages="pipeline.stages:STAGES",
        stop_requested=lambda: False,
        tell=lambda _share, _sentence: None,
    )


def test_a_saved_job_has_the_values_and_all_remarks_and_passes_the_check(tmp_path):
    read = loaded(tmp_path)
    session = Session(live_job(read.job, substeps=5))
    session.set("cloth.sheet.stretch_stiffness", 750.0)
    session.set("cloth.sheet.wind", (1.0, 0.0, 0.5))
    session.set("rigid.ball.density", 900.0)
    path, _ = save_job(read, session.values, tmp_path)
    text = path.read_text()
    assert path.name == "drape-live.toml"
    assert "# what nobody may lose: a remark" in text
    assert "# soft" in text
    job = load_checked_job(path)[0].job  # which raises what is wrong with it
    assert (job.name, job.cloth[0].substeps, job.cloth[0].stretch_stiffness) == ("drape-live", 5, 750.0)
    assert (job.cloth[0].wind, job.rigid[0].density) == ((1.0, 0.0, 0.5), 900.0)
    assert job.rigid[1].kind == "static"
    again = Session(live_job(job))  # what it is saved as is what it becomes
    assert again.values == {**session.values}
    assert save_job(read, session.values, tmp_path)[0].name == "drape-live-2.toml"


def test_a_recording_is_a_job_whose_frames_are_there_and_are_never_simulated_again(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET.replace('name = "drape"', 'name = "drape"\nduration = 2.0'))
    session = Session(live_job(read.job))
    recorder = Recorder(read, session, tmp_path / "renders", device="cpu")
    session.advance()
    assert recorder.toggle()
    session.drags.grab("rigid", "post", (0.4, 0.0, 0.1))
    session.drags.move("rigid", "post", (0.4, 0.0, 0.3))
    for _ in range(3):
        session.advance()
    expected = session.bodies()
    assert not recorder.toggle()
    folder = tmp_path / "renders" / "drape-take"
    assert str(folder / "job.toml") in session.message

    job = load_job(folder / "job.toml")
    assert (job.name, job.frame_count) == ("drape-take", 4)
    assert job.rigid[1].kind == "kinematic"  # the renderer asks each frame where it is
    assert json.loads((folder / "take.json").read_text())["take"] == job.recorded
    layout = JobLayout(folder)
    frame = read_frame(layout.path(layout.frame_cache(3)))
    for name, snapshot in expected.items():
        np.testing.assert_array_equal(frame.bodies[name].arrays["position"], snapshot.arrays["position"])

    assert stage_run(layout, "simulate").up_to_date == 1
    assert stage_run(layout, "cloth").ran == 4
    layout.path(layout.frame_cache(2)).unlink()
    (failed,) = stage_run(layout, "simulate").failures
    assert "no computation can make it anew" in failed.message
    assert "in a copy of the job file under another name" in failed.message
    assert not layout.path(layout.frame_cache(2)).exists()
    again = pipeline("rerun", folder, "--stage", "simulate")
    assert again.exit_code == 1
    assert "it cannot be simulated again" in again.output


def test_a_reset_ends_a_recording_with_what_was_before_it(tmp_path):
    session, recorder = recording(tmp_path)
    session.advance()
    session.reset()
    assert not recorder.is_recording
    assert load_job(tmp_path / "drape-take" / "job.toml").frame_count == 2
    session.advance()  # nobody records any more
    assert len(list((tmp_path / "drape-take" / "cache").glob("[0-9]*.h5"))) == 2


def take_of(folder, frames: int = 3, text: str = BALL_OVER_SHEET) -> tuple[Session, Recorder, JobLayout]:
    """A take of so many frames that has been ended."""
    session, recorder = recording(folder, folder / "elsewhere", text)
    for _ in range(frames - 1):
        session.advance()
    recorder.toggle()
    return session, recorder, JobLayout(folder / "elsewhere" / "drape-take")


def test_nobody_runs_a_recording_while_it_is_recorded_and_then_it_waits_to_be_started(tmp_path):
    session, recorder = recording(tmp_path, tmp_path / "farm")
    session.advance()
    spool = JobQueue(tmp_path / "farm")
    view = FarmView(Places(spool.farm), spool)

    def card() -> tuple[str, list[str]]:
        view.kept.forget()
        (found,) = view.glance().jobs
        return found.state, [action.label for action in actions_of(found, has_runner=False)]

    layout = spool.layout("drape-take")
    assert card() == ("running", [])
    for command in (
        ["submit", layout.job_file],
        ["resume", layout.root],
        ["clean", layout.root, "--all"],
    ):
        refused = pipeline(*command)
        assert refused.exit_code != 0, command
        assert "is being run already, by process" in refused.output
    with pytest.raises(JobBusyError):
        continuation(spool, "drape-take")
    assert spool.find("drape-take") is None
    recorder.stop()
    assert card() == ("recorded", ["Start"])
    assert continuation(spool, "drape-take")[0].name == "drape-take"


def wait_for_frames(recorder: Recorder, count: int) -> None:
    assert recorder._recording is not None
    until = time.monotonic() + 60.0
    while recorder._recording.frames < count:
        assert time.monotonic() < until
        time.sleep(0.001)


def test_a_frame_that_waited_while_another_process_took_the_folder_over_is_not_written(tmp_path):
    session, recorder = recording(tmp_path)
    session.advance()
    wait_for_frames(recorder, 2)
    folder = tmp_path / "drape-take"
    lease = JobLayout(folder).lease
    assert recorder._recording is not None
    lease.write_text(lease.read_text().replace(recorder._recording._lease.holder.token, "theirs"))
    session.advance()  # before any heartbeat
    recorder.stop()
    assert sorted(path.name for path in (folder / "cache").glob("[0-9]*.h5")) == ["000000.h5", "000001.h5"]
    assert session.message.endswith(f"; 2 frames are in {folder / 'cache'}")


def test_a_recording_whose_folder_another_process_has_taken_over_writes_nothing_more(tmp_path, monkeypatch):
    session, recorder = recording(tmp_path)
    session.advance()

    def lost(_lease: Lease) -> None:
        raise LeaseLostError("drape-take was taken over")

    wait_for_frames(recorder, 2)
    monkeypatch.setattr(Lease, "check", lost)
    monkeypatch.setattr(Lease, "heartbeat", lost)
    session.advance()
    assert not recorder.is_recording
    folder = tmp_path / "drape-take"
    became = f"2 frames are in {folder / 'cache'}"
    assert session.message == f"the recording ends early: drape-take was taken over; {became}"
    assert load_job(folder / "job.toml").frame_count == 1
    assert json.loads((folder / "take.json").read_text())["frames"] is None


def activity(layout: JobLayout) -> str:
    """What `status` says of a job behind the path of its folder."""
    root, _, told = pipeline("status", layout.root).output.splitlines()[0].partition(": ")
    assert root == str(layout.root)
    return told


def simulation_verdict(job_file: Path | str) -> str:
    planned = pipeline("plan", job_file, "--json")
    assert planned.exit_code == 0, planned.output
    return {each["task"]: each["verdict"] for each in json.loads(planned.output)}["simulate"]


def assert_told(text: str, *parts: str) -> None:
    assert [part for part in parts if part not in text] == [], text


def crashed(folder, monkeypatch, frames: int = 3, text: str = BALL_OVER_SHEET) -> tuple[JobQueue, JobLayout]:
    """A farm and its take of so many frames, which a killed process leaves: nobody writes what it is."""
    session, recorder = recording(folder, folder / "farm", text)
    for _ in range(frames - 1):
        session.advance()
    take = recorder._recording
    assert take is not None
    with monkeypatch.context() as dead:
        dead.setattr(take, "_write_result", lambda: None)
        take.end()
    spool = JobQueue(folder / "farm")
    return spool, spool.layout("drape-take")


@pytest.mark.parametrize("length", ["frames = 90", "duration = 1.5", "duration = 1.5\nfps = 30"])
def test_a_recording_whose_process_was_killed_has_all_its_frames_again_once_it_is_submitted(
    tmp_path, monkeypatch, length
):
    _, layout = crashed(tmp_path, monkeypatch, text=f"{length}\n{BALL_OVER_SHEET}")
    part = layout.path(layout.frame_cache(3)).with_name(".000003.h5.part.1")
    part.touch()  # it was writing
    assert load_job(layout.job_file).frame_count == 1
    assert_told(activity(layout), "cut short", "3 frames", f"submitting {layout.job_file}")
    submitted = []
    monkeypatch.setattr("pipeline.queue.submitting.run", lambda job, *_, **__: submitted.append(job.frame_count))
    ended = pipeline("submit", layout.job_file)
    assert ended.exit_code == 0, ended.output
    assert_told(ended.output, "drape-take was cut short", "3 frames")
    assert submitted == [3]
    assert load_job(layout.job_file).frame_count == 3
    assert not part.exists()
    assert json.loads((layout.root / "take.json").read_text())["frames"] == 3
    assert simulation_verdict(layout.job_file) == "up to date"
    assert "cut short" not in activity(layout)
    assert f"submitting {layout.job_file}" in activity(layout)


def test_the_dashboard_starts_a_recording_whose_process_was_killed_with_all_its_frames(tmp_path, monkeypatch):
    spool, layout = crashed(tmp_path, monkeypatch)
    (found,) = FarmView(Places(spool.farm), spool).glance().jobs
    assert (found.state, [action.label for action in actions_of(found, has_runner=False)]) == ("recorded", ["Start"])
    monkeypatch.setattr("pipeline.web.dashboard.actions.start_in_background", lambda _spool: None)
    told = Queue(spool).act("drape-take", "resume", "")
    assert_told(told, "drape-take was cut short", "3 frames", "drape-take is queued")
    assert load_job(layout.job_file).frame_count == 3


def test_frames_behind_one_that_is_damaged_are_told_of_and_taken_over_once_that_is_back(tmp_path, monkeypatch):
    _, layout = crashed(tmp_path, monkeypatch, frames=5)
    damaged = layout.path(layout.frame_cache(2))
    aside = damaged.rename(damaged.with_name("aside"))
    flaw = "cut short", "2 frames", "frame 2 is missing or damaged", "2 more lie behind it"
    assert_told(activity(layout), *flaw, f"submitting {layout.job_file}")
    assert_told(complete_interrupted_recording(layout), "drape-take", *flaw)
    assert load_job(layout.job_file).frame_count == 2
    assert_told(complete_interrupted_recording(layout), "drape-take", *flaw)
    aside.rename(damaged)
    completed = complete_interrupted_recording(layout)
    assert_told(completed, "cut short", "5 frames")
    assert "damaged" not in completed
    assert load_job(layout.job_file).frame_count == 5
    assert complete_interrupted_recording(layout) == ""


def test_a_recording_whose_first_frame_is_damaged_is_left_as_it_is_and_told_of(tmp_path, monkeypatch):
    _, layout = crashed(tmp_path, monkeypatch, frames=2)
    layout.path(layout.frame_cache(0)).write_bytes(b"")
    flaw = "cut short", "frame 0 is missing or damaged", "1 more lies behind it"
    assert_told(complete_interrupted_recording(layout), "drape-take", *flaw)
    assert load_job(layout.job_file).frame_count == 1
    assert_told(activity(layout), *flaw)
    assert "submitting" not in activity(layout)


def test_status_promises_no_film_of_a_recording_whose_folder_has_another_job(tmp_path, monkeypatch):
    _, layout = crashed(tmp_path, monkeypatch)
    text = layout.job_file.read_text()
    layout.job_file.write_text("".join(line for line in text.splitlines(True) if not line.startswith("recorded")))
    assert_told(activity(layout), f"{layout.job_file} is not its job", "no film")
    layout.recording_story.unlink()
    assert "its record holds no tasks" in activity(layout)


def test_a_length_that_was_chosen_for_a_killed_recording_stays(tmp_path, monkeypatch):
    _, layout = crashed(tmp_path, monkeypatch)
    found = frames_of_interrupted_recording(layout)
    assert found is not None
    assert (found.whole, found.flaw) == (3, "")
    layout.job_file.write_text(layout.job_file.read_text().replace("frames = 1", "frames = 7"))
    complete_interrupted_recording(layout)
    assert load_job(layout.job_file).frame_count == 7
    assert (frames_of_interrupted_recording(layout), complete_interrupted_recording(layout)) == (None, "")


def test_a_recording_whose_lease_did_not_answer_but_is_its_own_still_becomes_a_film_of_all_its_frames(tmp_path):
    session, recorder = recording(tmp_path)
    session.advance()
    assert recorder._recording is not None
    recorder._recording._lease._loss = LeaseLostError("runner.lease could not be renewed for 60 s")
    session.advance()
    assert not recorder.is_recording
    folder = tmp_path / "drape-take"
    told = f"runner.lease could not be renewed for 60 s; 2 frames: pipeline submit {folder / 'job.toml'}"
    assert session.message == f"the recording ends early: {told}"
    assert load_job(folder / "job.toml").frame_count == 2
    assert json.loads((folder / "take.json").read_text())["frames"] == 2


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "[Errno 28] No space left on device"),
        (MemoryError(), "MemoryError"),
        (RuntimeError("[cuda] out of memory"), "RuntimeError: [cuda] out of memory"),
    ],
)
def test_a_recording_that_cannot_be_written_on_keeps_the_frames_that_were(tmp_path, monkeypatch, error, told):
    from pipeline.web.live import recording as module

    def write_two(path, bodies, report, *, device):
        if report.frame == 2:
            raise error
        write_frame(path, bodies, report, device=device)

    write_frame = module.write_frame
    monkeypatch.setattr(module, "write_frame", write_two)
    session, recorder = recording(tmp_path)
    for _ in range(6):
        session.advance()
    recorder.stop()
    assert not recorder.is_recording
    folder = tmp_path / "drape-take"
    assert session.message == f"the recording ends early: {told}; 2 frames: pipeline submit {folder / 'job.toml'}"
    assert load_job(folder / "job.toml").frame_count == 2
    assert json.loads((folder / "take.json").read_text())["frames"] == 2
    assert not [thread for thread in threading.enumerate() if thread.name == "writer"]


def test_a_frame_that_there_is_no_memory_to_hand_in_ends_the_recording_and_is_told(tmp_path, monkeypatch):
    from pipeline.web.live import recording as module

    session, recorder = recording(tmp_path)

    def replace(*_arguments, **_changes):
        raise MemoryError("no 9 GiB")

    monkeypatch.setattr(module, "replace", replace)
    session.advance()
    assert not recorder.is_recording
    became = f"1 frame: pipeline submit {tmp_path / 'drape-take' / 'job.toml'}"
    assert session.message == f"the recording ends early: MemoryError: no 9 GiB; {became}"


def test_what_is_printed_of_a_recording_works_from_anywhere(tmp_path, monkeypatch):
    session, _, layout = take_of(tmp_path)
    (tmp_path / "away").mkdir()
    monkeypatch.chdir(tmp_path / "away")
    _, _, printed = session.message.partition("pipeline submit ")
    (job_file,) = shlex.split(printed)
    assert simulation_verdict(job_file) == "up to date"
    found = pipeline("status", job_file)  # by its file alone, as `submit` finds it
    assert (found.exit_code, found.output.partition(":")[0]) == (0, str(layout.root))


def test_no_cleaning_but_of_everything_removes_the_frames_of_a_recording(tmp_path):
    _, _, layout = take_of(tmp_path)
    job = load_job(layout.job_file)
    refused = pipeline("clean", layout.root, "--stage", "simulate", "--yes")
    assert refused.exit_code == 1
    assert_told(refused.output, "drape-take", str(job.recorded), "nothing can make its frames anew", "--all")
    layout.job_file.write_text(layout.job_file.read_text().replace("frames = 3", "frames = 1"))
    assert pipeline("clean", layout.root, "--superseded", "--yes").exit_code == 0
    assert len(list((layout.root / "cache").glob("[0-9]*.h5"))) == 3
    assert pipeline("clean", layout.root, "--all", "--yes").exit_code == 0
    assert not layout.root.exists()


def test_another_rate_of_frames_of_a_recording_is_told_as_such(tmp_path):
    _, _, layout = take_of(tmp_path)
    layout.job_file.write_text("fps = 24\n" + layout.job_file.read_text())
    (failed,) = stage_run(layout, "simulate").failures
    assert "recorded at 60 frames a second, and the job asks for 24: write fps = 60 again" in failed.message


def test_a_job_that_is_saved_of_a_recording_is_simulated_and_its_bodies_rest_again(tmp_path):
    _, _, layout = take_of(tmp_path)
    read = read_job(layout.job_file)
    assert read.job.rigid[1].kind == "kinematic"
    values = Session(live_job(read.job)).values
    path, note = save_job(read, values, tmp_path)
    saved = load_checked_job(path)[0].job
    assert (saved.recorded, saved.rigid[1].kind, note) == (None, "static", "")
    assert "# what nobody may lose: a remark" in path.read_text()
    (layout.root / "take.json").unlink()
    path, note = save_job(read, values, tmp_path)
    assert load_job(path).recorded is None
    assert "bodies that rested before the recording may be kinematic" in note


def test_a_job_that_another_session_saves_meanwhile_is_not_overwritten(tmp_path, monkeypatch):
    from pipeline.web.live import saving

    read = loaded(tmp_path)
    values = Session(live_job(read.job)).values
    theirs = tmp_path / "drape-live.toml"

    def while_they_save(*arguments):
        theirs.touch()
        return text_with_values(*arguments)

    text_with_values = saving.text_with_values
    monkeypatch.setattr(saving, "text_with_values", while_they_save)
    assert save_job(read, values, tmp_path)[0] == tmp_path / "drape-live-2.toml"
    assert theirs.read_bytes() == b""


def test_ctrl_c_ends_a_recording_tells_what_became_of_it_and_leaves_signals_as_they_were(tmp_path, monkeypatch):
    from pipeline.web.live import running

    class Interrupted(Recorder):
        """One that is recording when Ctrl-C comes."""

        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options)
            self.toggle()
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(running, "Recorder", Interrupted)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    ended = live(tmp_path)
    assert ended.exit_code == 0
    assert f"1 frame: pipeline submit {tmp_path / 'drape-take' / 'job.toml'}\n" in ended.output
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("is_built_anew", [False, True])
def test_where_live_cannot_go_on_the_terminal_tells_what_became_of_the_recording(tmp_path, monkeypatch, is_built_anew):
    from pipeline.web.live import running

    class Recording(Recorder):
        """One that is recording from the start."""

        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options)
            self.toggle()

    def fails(session: Session, _page, *, ends) -> None:
        if is_built_anew:
            session.on_jump()
            raise CannotGoOnError("drape cannot begin anew: MemoryError: no 9 GiB")
        raise MemoryError("no 9 GiB")

    monkeypatch.setattr(running, "Recorder", Recording)
    monkeypatch.setattr(running, "run", fails)
    ended = live(tmp_path)
    assert ended.exit_code == 1
    became = f"; 1 frame: pipeline submit {tmp_path / 'drape-take' / 'job.toml'}"
    (told,) = (line for line in ended.output.splitlines() if line.startswith("error: "))
    assert told.endswith(f"MemoryError: no 9 GiB{became}")
