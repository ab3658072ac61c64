"""From a job file to a film, and what each kind of change makes anew."""

import json
import re
from pathlib import Path

import av
import pytest
from films import FRAMES, STAGE_NAMES, Finished, Studio, stage_of
from PIL import Image

FILES = 1 + 8 * FRAMES + 2
"""The ball's mesh; cache, kinds, drops, surface, cloth, whitewater, volume and picture of each frame; segment, film."""
TASKS = 1 + 1 + 6 * FRAMES + 2  # the same, with one task for all of the cache


def test_submit_makes_every_file_and_a_film_of_the_right_size_and_length(first_submit: tuple[Studio, Finished]) -> None:
    studio, submitted = first_submit
    root = studio.layout.root
    assert submitted.out.startswith(f"renders/tiny/movie.mp4: {FRAMES} frames, 0.1 s of film, in ")
    for stage in STAGE_NAMES:
        files = {"bodies": 1, "movie": 2, "spray": 2 * FRAMES}.get(stage, FRAMES)
        assert re.search(rf"{stage} (\(.*\) )?{files}/{files}", submitted.err), submitted.err
    assert len(studio.artifacts()) == FILES
    assert set(studio.attempts().values()) == {1}
    with av.open(root / "movie.mp4") as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.width, stream.height) == ("h264", 64, 36)
        assert stream.average_rate == 60
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
        assert film.duration / av.time_base == pytest.approx(FRAMES / 60, abs=1e-3)  # the container counts in ms
    assert len(pictures) == FRAMES
    assert all(picture.std() > 5 for picture in pictures)  # a flat picture has none; the ball and water have tens
    with Image.open(root / "frames/000000.png") as still:
        assert still.size == (64, 36)
    assert not [path for path in root.rglob("*") if ".part" in path.name]


def test_submitted_again_it_is_up_to_date_and_runs_nothing(finished: Studio) -> None:
    attempts, times = finished.attempts(), finished.mtimes_ns()
    again = finished.submit()
    assert again.out == "up to date: renders/tiny/movie.mp4\n"
    assert again.err == ""
    assert finished.tasks_run_since(attempts) == set()
    assert finished.mtimes_ns() == times


def test_a_finished_job_can_be_looked_at_from_all_sides(finished: Studio) -> None:
    status = json.loads(finished.run("status", "tiny", "--json").assert_code(0).out)
    assert status["runner"] is None
    assert list(status["stages"]) == STAGE_NAMES
    assert status["failures"] == []
    assert status["simulation"]["frame"] == FRAMES - 1
    assert status["simulation"]["solvers"]["water"]["particle_count"] > 0
    assert status["simulation"]["solvers"]["cloth"]["node_count"] == 49
    assert "<figcaption>Energy [J]</figcaption>" in finished.layout.report.read_text()  # left there by submit
    assert finished.run("status", "tiny").assert_code(0).out.startswith("renders/tiny: done\n")
    plan = json.loads(finished.run("plan", "tiny.toml", "--json").assert_code(0).out)
    assert {each["verdict"] for each in plan} == {"up to date"}
    checked = json.loads(finished.run("verify", "tiny", "--deep", "--json").assert_code(0).out)
    assert checked == {"checked": FILES, "deep": True, "flaws": {}, "texts": []}
    story = finished.run("explain", "tiny", "render/000002").assert_code(0).out
    assert story.startswith("render/000002: done, up to date\n")
    assert "frames/000002.png" in story
    assert "attempt 1 on " in story
    assert "starting at frame 0" in finished.run("explain", "tiny", "simulate", "--log").assert_code(0).out
    assert len(finished.run("explain", "tiny", "--log").assert_code(0).out.splitlines()) == TASKS


def test_what_is_not_there_is_refused_with_the_nearest_name(finished: Studio) -> None:
    assert 'did you mean "render/000002"?' in finished.run("explain", "tiny", "render/00002").assert_code(1).err
    assert "no submitted job in renders/tinny" in finished.run("status", "tinny").assert_code(1).err
    assert "no log of a task" in finished.run("explain", "tiny", "rendr/000002", "--log").assert_code(1).err
    assert "the stages are bodies, simulate" in finished.run("clean", "tiny", "--stage", "rendr").assert_code(1).err
    assert "the stages are bodies, simulate" in finished.run("rerun", "tiny", "--stage", "rendr").assert_code(1).err


def test_clean_removes_nothing_unless_told_twice(finished: Studio) -> None:
    before = finished.artifacts()
    dry = finished.run("clean", "tiny", "--stage", "render").assert_code(0)
    assert dry.out.startswith(f"would remove {FRAMES} files")
    assert finished.artifacts() == before
    wet = finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    assert wet.out.startswith(f"removing {FRAMES} files")
    assert before.keys() - finished.artifacts().keys() == {f"frames/{k:06d}.png" for k in range(FRAMES)}


def test_clean_all_removes_the_folder_but_only_one_that_holds_a_job(finished: Studio) -> None:
    dry = finished.run("clean", "tiny", "--all").assert_code(0)
    assert dry.out.endswith("nothing was removed; add --yes to do it\n")
    assert finished.layout.manifest.exists()
    finished.run("clean", "tiny", "--all", "--yes").assert_code(0)
    assert not finished.layout.root.exists()
    mine = finished.folder / "mine"
    mine.mkdir()
    (finished.folder / "tiny.toml").rename(mine / "job.toml")
    assert "holds no finished work" in finished.run("clean", str(mine), "--all", "--yes").assert_code(1).err
    assert (mine / "job.toml").exists()


@pytest.mark.slow
def test_another_camera_renders_again_and_simulates_nothing(finished: Studio) -> None:
    attempts, before = finished.attempts(), finished.artifacts()
    submitted = finished.submit("--set", "camera.focal_length_mm=70")
    assert "render 0-5: stale, camera.focal_length_mm changed from 50.0 to 70.0" in submitted.err
    assert {stage_of(task) for task in finished.tasks_run_since(attempts)} == {"render", "movie"}
    after = finished.artifacts()
    assert {path.partition("/")[0] for path in before if before[path] != after[path]} == {
        "frames",
        "movie",
        "movie.mp4",
    }


@pytest.mark.slow
def test_a_longer_film_continues_the_shorter_one_and_equals_one_made_at_once_on_one_core(
    splash: Studio, empty: Studio, tmp_path: Path
) -> None:
    film = splash.copy(tmp_path / "longer")
    attempts, before, times = film.attempts(), film.artifacts(), film.mtimes_ns()
    film.submit("--set", "frames=9")
    kept = {path for path in before if not path.startswith("movie")}
    assert {path: film.artifacts()[path] for path in kept} == {path: before[path] for path in kept}
    assert {path: film.mtimes_ns()[path] for path in kept} == {path: times[path] for path in kept}
    assert "starting at frame 5" in film.run("explain", "tiny", "simulate", "--log").out
    assert not {task for task in film.tasks_run_since(attempts) if task.endswith(("000000", "000005"))}
    empty.submit("--set", "frames=9", "--cores", "1")  # neither how often it was begun nor their number matters
    film.assert_whole(like=empty)
    attempts = film.attempts()
    film.submit()  # a shorter one again needs another film only
    assert {stage_of(task) for task in film.tasks_run_since(attempts)} == {"movie"}


@pytest.mark.slow
def test_rerun_makes_just_these_frames_and_the_film_stays_as_their_pixels_are_the_same(
    finished: Studio, reference: Studio
) -> None:
    attempts, times = finished.attempts(), finished.mtimes_ns()
    again = finished.run("rerun", "tiny", "--stage", "render", "--frames", "2-3").assert_code(0)
    assert "render 2-3" in again.err
    assert finished.tasks_run_since(attempts) == {"render/000002", "render/000003"}
    finished.assert_whole(like=reference)
    assert finished.mtimes_ns()["movie.mp4"] == times["movie.mp4"]


@pytest.mark.slow
def test_cleaned_stages_are_made_again_and_only_they(finished: Studio, reference: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "surface", "--stage", "movie", "--yes").assert_code(0)
    attempts = finished.attempts()
    finished.submit()
    assert {stage_of(task) for task in finished.tasks_run_since(attempts)} == {"surface", "movie"}
    finished.assert_whole(like=reference)


def test_a_moved_folder_is_still_up_to_date(finished: Studio, tmp_path: Path) -> None:
    elsewhere = tmp_path / "another place" / "my film"
    elsewhere.parent.mkdir()
    finished.layout.root.rename(elsewhere)
    resumed = finished.run("resume", str(elsewhere)).assert_code(0)
    assert resumed.out == f"up to date: {elsewhere}/movie.mp4\n"


@pytest.mark.slow
def test_preview_makes_a_smaller_film_beside_the_other(splash: Studio, tmp_path: Path) -> None:
    film = splash.copy(tmp_path)
    before = film.artifacts()
    film.submit("--preview")
    assert film.artifacts() == before
    with av.open(film.folder / "renders/tiny-preview/movie.mp4") as movie:
        stream = movie.streams.video[0]
        assert (stream.width, stream.height, stream.frames) == (32, 18, FRAMES)
