"""The queue of a farm whose commands are real processes where several take part: jobs take turns, and none is lost."""

import os
import shutil
import signal
from collections.abc import Iterator
from subprocess import Popen

import pytest
from farm_processes import Farm, wait_until
from synthetic_jobs import contents, run_synthetic

from pipeline.queue.job_queue import Desired, new_entry
from pipeline.record.reader import SUCCEEDED
from pipeline.run.executors.inline import InlineExecutor


@pytest.fixture
def farm(tmp_path) -> Iterator[Farm]:
    farm = Farm(tmp_path)
    yield farm
    farm.close()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, bytes]:
    """What six frames of the synthetic job are."""
    root = tmp_path_factory.mktemp("undisturbed") / "job"
    with InlineExecutor() as executor:
        run_synthetic(root, executor)
    return contents(root)


def start_long(farm: Farm, name: str) -> Popen[str]:
    """Submit a job of sixty slow frames; returns when it has made some."""
    process = farm.start("submit", farm.job(name, frames=60, pause_s=1.0).name)
    wait_until(lambda: farm.frames_done(name) > 0, "it never began to work")
    return process


def assert_done_once(farm: Farm, *names: str, like: dict[str, bytes]) -> None:
    for name in names:
        assert contents(farm.layout(name).root) == like
        succeeded = [row.task for row in farm.attempts(name) if row.outcome == SUCCEEDED]
        assert len(succeeded) == len(set(succeeded)) == 8
    assert farm.queue.listing().jobs == ()


def assert_long_done_once(farm: Farm, name: str, *, begins: dict[str, bytes]) -> None:
    """Sixty frames, which nobody waits for: a test lets go of their pauses when it has seen what it wants to see."""
    whole = contents(farm.layout(name).root)
    assert len(whole) == 121
    assert all(whole[each] == content for each, content in begins.items() if each != "film.bin")
    succeeded = [row.task for row in farm.attempts(name) if row.outcome == SUCCEEDED]
    assert len(succeeded) == len(set(succeeded)) == 62


@pytest.mark.slow
def test_two_submits_at_once_take_turns(farm, undisturbed):
    files = [farm.job(name, pause_s=0.02) for name in "ab"]
    for process in [farm.start("submit", path.name) for path in files]:
        farm.finish(process)
    assert_done_once(farm, "a", "b", like=undisturbed)
    spans = [
        (min(row.started for row in farm.attempts(name)), max(row.finished or 0.0 for row in farm.attempts(name)))
        for name in "ab"
    ]
    first, second = sorted(spans)
    assert first[1] <= second[0]  # one after the other


@pytest.mark.slow
def test_a_more_urgent_job_goes_first_and_the_other_continues_where_it_was(farm, undisturbed):
    slow = start_long(farm, "slow")
    urgent = farm.start("submit", farm.job("urgent").name, "--priority", "5")
    wait_until(lambda: farm.queue.find("urgent") is not None, "it was never queued")
    assert "renders/urgent/movie.mp4 is done" in farm.finish(urgent).err
    assert farm.frames_done("slow") < 60
    farm.faults("slow", {})  # no pauses any more
    assert "urgent is more urgent; slow continues after it" in farm.finish(slow).err
    assert_done_once(farm, "urgent", like=undisturbed)
    assert_long_done_once(farm, "slow", begins=undisturbed)


@pytest.mark.slow
def test_a_job_submitted_detached_runs_in_the_background_and_can_be_watched(farm, undisturbed):
    submitted = farm.run("submit", farm.job("a", pause_s=0.1).name, "--detach")
    assert "a is queued; the queue runs in the background" in submitted.out
    assert not submitted.out.startswith("renders/")
    assert farm.here("status", "a", "--follow").code == 0
    wait_until(lambda: farm.settled("a"), "it was never settled")
    assert_done_once(farm, "a", like=undisturbed)


@pytest.mark.slow
def test_a_terminal_that_has_its_own_film_leaves_detached_jobs_to_the_background(farm, undisturbed):
    own = farm.start("submit", farm.job("own", frames=60, pause_s=1.0).name)
    wait_until(lambda: farm.is_running("own"), "it never began")
    farm.run("submit", farm.job("other").name, "--detach")
    farm.faults("own", {})
    assert "jobs that wait go on in the background" in farm.finish(own).err
    wait_until(lambda: farm.settled("other"), "nobody ran it")
    assert_done_once(farm, "other", like=undisturbed)
    assert_long_done_once(farm, "own", begins=undisturbed)


@pytest.mark.slow
def test_ctrl_c_while_a_job_of_somebody_else_runs_pauses_the_own_one_and_leaves_the_other_queued(farm, undisturbed):
    other = farm.job("other", frames=60, pause_s=1.0)
    farm.queue.put(new_entry("other", text=other.read_text(), background=True))
    terminal = farm.start("submit", farm.job("own").name)
    wait_until(lambda: farm.frames_done("other") > 0, "it never began to work")
    terminal.send_signal(signal.SIGINT)
    assert "continue with: pipeline resume renders/own" in farm.finish(terminal, code=130).err
    assert (entry := farm.queue.find("own")) is not None
    assert (entry.desired, entry.note, farm.frames_done("own")) == (Desired.PAUSE, "stopped by hand", 0)
    farm.faults("other", {})
    wait_until(lambda: farm.settled("other"), "it did not go on in the background")
    assert_long_done_once(farm, "other", begins=undisturbed)
    farm.here("cancel", "own")


@pytest.mark.slow
def test_paused_resumed_and_nothing_is_done_twice(farm, undisturbed):
    submitted = start_long(farm, "a")
    assert "a pauses as soon as what runs is finished" in farm.here("pause", "a").out
    stopped = farm.finish(submitted, code=8)
    assert "asked to pause" in stopped.err
    assert farm.listed()["a"]["state"] == "paused"
    assert 0 < farm.frames_done("a") < 60
    assert farm.here("status", "a", "--follow", code=8).err.strip().endswith("continue with: pipeline resume renders/a")
    farm.faults("a", {})
    farm.here("resume", "a")
    assert_long_done_once(farm, "a", begins=undisturbed)
    assert farm.queue.listing().jobs == ()


@pytest.mark.slow
def test_cancelled_stops_at_once_and_keeps_what_is_finished(farm):
    running = farm.start("submit", farm.job("a", pause_s=1.5).name)
    wait_until(lambda: farm.frames_done("a") > 0, "it never began to work")
    farm.faults("a", {}, pause_s=600.0)
    waiting = farm.start("submit", farm.job("b").name)
    wait_until(lambda: farm.queue.find("b") is not None, "it was never queued")
    assert "b is cancelled" in farm.here("cancel", "b").out
    assert "it was cancelled before it ran" in farm.finish(waiting, code=8).err
    farm.here("cancel", "a")
    assert "cancelled: stopping at once" in farm.finish(running, code=8).err
    assert 0 < farm.frames_done("a") < 6
    assert farm.queue.listing().jobs == ()
    assert '"a" is not in the queue' in farm.here("cancel", "a", code=1).err


@pytest.mark.slow
def test_cancelled_while_its_own_command_runs_a_more_urgent_job(farm):
    low = start_long(farm, "low")
    farm.job("urgent", pause_s=600.0)
    urgent = farm.start("submit", "urgent.toml", "--priority", "5")
    wait_until(lambda: farm.is_running("urgent"), "the more urgent job never ran")
    farm.here("cancel", "low")
    farm.faults("urgent", {})
    farm.here("cancel", "urgent")
    farm.finish(urgent, code=8)
    farm.finish(low, code=8)
    assert farm.queue.listing().jobs == ()


@pytest.mark.slow
def test_failed_tasks_are_tried_again_by_rerun(farm, undisturbed):
    path = farm.job("a")
    farm.faults("a", {"double/000002": ["fail"]})
    farm.here("submit", path.name, code=5)
    failed = farm.listed()["a"]
    assert (failed["state"], failed["done"], failed["tasks"]) == ("failed", 6, 8)
    assert failed["note"] == "double/000002: ValueError: a fault of the task's own"
    assert "it failed: double/000002" in farm.here("status", "a", "--follow", code=5).err
    farm.here("rerun", "--failed", "a")
    assert_done_once(farm, "a", like=undisturbed)


@pytest.mark.slow
def test_when_a_runner_is_killed_whoever_waits_takes_the_queue_over(farm, undisturbed):
    runner = start_long(farm, "a")
    waiting = farm.start("submit", farm.job("b").name)
    wait_until(lambda: farm.queue.find("b") is not None, "it was never queued")
    os.kill(runner.pid, signal.SIGKILL)
    runner.wait()
    farm.faults("a", {})
    taken_over = farm.finish(waiting)
    assert f"taking over from process {runner.pid}" in taken_over.err
    assert_done_once(farm, "b", like=undisturbed)
    assert_long_done_once(farm, "a", begins=undisturbed)


@pytest.mark.slow
def test_a_second_runner_of_the_queue_waits_and_takes_over_from_one_that_is_killed(farm, undisturbed):
    runner, second = start_long(farm, "a"), farm.start("work")
    assert second.stderr is not None
    assert "is being run already" in second.stderr.readline()
    os.kill(runner.pid, signal.SIGKILL)
    runner.wait()
    farm.faults("a", {})
    assert f"taking over from process {runner.pid}" in farm.finish(second).err
    assert_long_done_once(farm, "a", begins=undisturbed)


@pytest.mark.slow
def test_a_second_runner_ends_with_the_queue(farm):
    runner, second = start_long(farm, "a"), farm.start("work")
    assert second.stderr is not None
    assert "is being run already" in second.stderr.readline()
    farm.faults("a", {})
    assert farm.finish(runner).code == 0
    assert "the queue is empty" in farm.finish(second).err


@pytest.mark.slow
def test_another_version_submitted_meanwhile_follows_and_both_commands_end_well(farm):
    first = start_long(farm, "a")
    second = farm.start("submit", farm.job("a", frames=60, pause_s=1.0, focal_length_mm=70.0).name)
    wait_until(lambda: (entry := farm.queue.find("a")) is not None and entry.text is not None, "never queued")
    farm.faults("a", {})
    farm.finish(first)
    assert "it runs an earlier version of the job; this one follows" in farm.finish(second).err
    assert contents(farm.layout("a").root)["double/000000.bin"].startswith(b"70.0")
    assert farm.queue.listing().jobs == ()


@pytest.mark.slow
def test_a_folder_moved_elsewhere_continues_there(farm, tmp_path, undisturbed):
    submitted = start_long(farm, "a")
    farm.here("pause", "a")
    farm.finish(submitted, code=8)
    farm.faults("a", {})
    elsewhere = tmp_path / "another disk" / "films"
    elsewhere.mkdir(parents=True)
    shutil.move(farm.layout("a").root, elsewhere / "mine")
    done = farm.here("resume", str(elsewhere / "mine"))
    assert done.out.startswith(f"{elsewhere.relative_to(tmp_path)}/mine/movie.mp4")
    moved = contents(elsewhere / "mine")
    assert len(moved) == 121
    assert all(moved[each] == content for each, content in undisturbed.items() if each != "film.bin")
    # The old place neither makes it anew nor forgets it without a word.
    assert farm.listed()["a"]["state"] == "paused"
    farm.here("rerun", "--failed", "a", code=1)
    assert not farm.layout("a").job_file.exists()
    assert "is gone" in farm.listed()["a"]["note"]
    farm.here("cancel", "a")


@pytest.mark.slow
def test_a_disk_that_gets_too_full_pauses_the_job_and_more_room_continues_it(farm, undisturbed):
    refused = farm.here("submit", farm.job("a").name, "--reserve", "1000TB", code=7)
    assert "less than the reserve" in refused.err
    entry = farm.queue.find("a")
    assert entry is not None
    assert (entry.desired, farm.frames_done("a")) == (Desired.PAUSE, 0)
    farm.here("resume", "a", "--reserve", "0")
    assert_done_once(farm, "a", like=undisturbed)
