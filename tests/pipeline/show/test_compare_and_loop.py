"""`pipeline compare` and `pipeline loop`: films side by side, and small films that start again."""

import sqlite3
from contextlib import closing
from pathlib import Path

import av
import drawing_stages
import numpy as np
import pytest
from command_line import pipeline
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.base.task import task_fingerprint
from pipeline.job.loading import load_job
from pipeline.record.manifest import Manifest
from pipeline.run.plan import plan_job
from pipeline.store.artifacts import committing
from render.loop import write_loop
from render.pictures import read_picture

SIZE = (96, 64)
SCENE = '[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.1 }\n'


@pytest.fixture(autouse=True)
def pictures_without_a_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that are made of the job file alone."""
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)


def film(
    folder: Path,
    color: tuple[int, int, int],
    *,
    frames: int = 12,
    fps: int = 60,
    planned: int = 12,
    step: int = 4,
    gravity: float = -9.0,
) -> Path:
    """A job's folder whose frames are plain, brighter by so many levels each, and committed."""
    layout = JobLayout(folder)
    layout.root.mkdir(parents=True, exist_ok=True)
    text = f'name = "{folder.name}"\nfps = {fps}\ngravity = [0.0, 0.0, {gravity}]\n'
    layout.job_file.write_text(f"{text}frames = {max(frames, planned)}\n{SCENE}")
    tasks = plan_job(load_job(layout.job_file), layout, drawing_stages.STAGES)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks)
        for frame, task in enumerate(tasks[:frames]):
            picture, fingerprint = layout.picture(frame), task_fingerprint(task, {})
            with committing(
                layout, picture, task=task, attempt=1, fingerprint=fingerprint, validate=read_picture
            ) as new:
                shade = tuple(level + step * frame for level in color)
                Image.new("RGB", SIZE, shade).save(new.path, format="PNG")
            manifest.record_artifact(new.receipt)
    layout.job_file.write_text(f"{text}frames = {planned}\n{SCENE}")
    return folder


def compared(folder: Path, *jobs: Path, told: str = "") -> tuple[list[np.ndarray], float]:
    """Frames and rate of the comparison of jobs, of which a sentence is told."""
    result = pipeline("compare", *jobs, "-o", folder / "both.mp4")
    assert result.exit_code == 0, result.output
    assert told in result.stderr
    return decode(folder / "both.mp4")


def red_and_blue(folder: Path) -> tuple[Path, Path]:
    return film(folder / "red", (160, 20, 20)), film(folder / "blue", (20, 20, 160))


def decode(path: Path) -> tuple[list[np.ndarray], float]:
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        frames = [
            frame.reformat(format="rgb24", src_colorspace=1, dst_colorspace=1).to_ndarray().astype(int)
            for frame in container.decode(video=0)
        ]
    return frames, rate


def test_films_stand_side_by_side_with_their_names_under_them(tmp_path):
    frames, rate = compared(tmp_path, *red_and_blue(tmp_path))
    assert (len(frames), rate) == (12, 60.0)
    for number, frame in enumerate(frames):
        assert frame.shape[1] == 2 * SIZE[0] + 8
        # A lossy codec of 8 bits, and chroma of half the size, which plain areas do not suffer from.
        np.testing.assert_allclose(frame[32, 48], (160 + 4 * number, 20 + 4 * number, 20 + 4 * number), atol=4)
        np.testing.assert_allclose(frame[32, 152], (20 + 4 * number, 20 + 4 * number, 160 + 4 * number), atol=4)
    for left in (0, SIZE[0] + 8):
        caption = frames[0][SIZE[1] + 2 :, left : left + SIZE[0]]
        assert caption.max() > 150 and np.median(caption) < 60  # light letters on a dark ground


def test_films_of_other_rates_show_equal_times_and_end_with_the_shortest(tmp_path):
    fast = film(tmp_path / "fast", (100, 20, 20), frames=12)
    slow = film(tmp_path / "slow", (20, 20, 100), frames=5, fps=30, planned=6, step=20)
    frames, rate = compared(tmp_path, fast, slow, told="slow: 5 of 6 frames are there")
    assert (len(frames), rate) == (10, 60.0)
    shown = [round((frame[32, 152, 2] - 100) / 20) for frame in frames]
    assert shown == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def change(job: Path, frames: int) -> None:
    """Change a job, and draw its first frames anew."""
    film(job, (20, 160, 20), frames=frames, gravity=-20.0)


def test_frames_of_an_earlier_version_of_a_job_are_not_compared(tmp_path):
    red, blue = red_and_blue(tmp_path)
    change(blue, 5)
    told = "blue: 5 of 12 frames are there (7 more are of an earlier version of it)"
    frames, _ = compared(tmp_path, red, blue, told=told)
    assert len(frames) == 5
    for frame in frames:
        assert frame[32, 152].argmax() == 1  # green, as drawn last


def test_a_film_that_would_be_made_otherwise_now_is_shown_and_that_is_told(tmp_path):
    red, blue = red_and_blue(tmp_path)
    change(blue, 0)
    told = "blue: its frames are not as the job would be made now; what differs: render\n"
    assert len(compared(tmp_path, red, blue, told=told)[0]) == 12
    assert pipeline("loop", blue, "-o", tmp_path / "blue.webp").stderr == told


@pytest.mark.parametrize("record", ["gone", "old"])
def test_frames_of_which_there_are_receipts_only_or_an_old_record_are_shown(tmp_path, record):
    red = film(tmp_path / "red", (160, 20, 20))
    manifest = JobLayout(red).manifest
    if record == "gone":  # as `run-stage` and OpenJobDescription leave them
        manifest.unlink()
    else:
        with closing(sqlite3.connect(manifest)) as connection:
            connection.execute("PRAGMA user_version = 1")
    for command in (("loop", red, "-o", tmp_path / "red.webp"), ("compare", red, red, "-o", tmp_path / "both.mp4")):
        result = pipeline(*command)
        assert result.exit_code == 0, result.output
        assert result.stderr == ""
    assert len(decode(tmp_path / "both.mp4")[0]) == 12


def test_frames_of_an_earlier_version_of_a_job_are_not_looped(tmp_path):
    red = film(tmp_path / "red", (160, 20, 20))
    change(red, 5)
    result = pipeline("loop", red, "-o", tmp_path / "red.webp")
    assert result.exit_code == 1
    assert "only 0-4 are rendered (7 more are of an earlier version of it); choose with --until" in result.stderr
    assert pipeline("loop", red, "--until", 4, "-o", tmp_path / "red.webp").exit_code == 0
    with Image.open(tmp_path / "red.webp") as loop:
        red_level, green_level, _ = loop.convert("RGB").getpixel((48, 32))
    assert green_level > red_level


@pytest.mark.parametrize(
    ("jobs", "target", "sentence"),
    [
        (["red"], "both.mp4", "name two jobs at least"),
        (["red", "red"], "both.avi", 'must end in ".mp4"'),
        (["red", "bare"], "both.mp4", "has not been rendered yet"),
    ],
)
def test_what_cannot_be_compared_is_told(tmp_path, jobs, target, sentence):
    film(tmp_path / "red", (160, 20, 20))
    film(tmp_path / "bare", (0, 0, 0), frames=0)
    result = pipeline("compare", *(tmp_path / job for job in jobs), "-o", tmp_path / target)
    assert result.exit_code in (1, 2)
    assert sentence in result.stderr
    assert not (tmp_path / target).exists()


@pytest.mark.parametrize("order", [1, -1])
def test_pictures_of_several_sizes_are_no_loop_and_told_in_a_line(tmp_path, order):
    small, large = tmp_path / "small.png", tmp_path / "large.png"
    Image.new("RGB", (48, 32)).save(small)
    Image.new("RGB", SIZE).save(large)
    with pytest.raises(ValueError, match="is of another size than"):
        write_loop([small, large][::order], tmp_path / "loop.webp", fps=15.0, width=640, loop_fps=15.0)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_loop_shows_frames_at_its_own_rate_for_ever(tmp_path, suffix):
    red = film(tmp_path / "red", (160, 20, 20))
    target = tmp_path / f"red{suffix}"
    result = pipeline("loop", red, "--fps", 20, "--width", 48, "-o", target)
    assert result.exit_code == 0, result.output
    with Image.open(target) as loop:
        assert (loop.n_frames, loop.size, loop.info["loop"]) == (4, (48, 32), 0)
        reds, durations = [], []
        for number in range(4):
            loop.seek(number)
            loop.load()
            reds.append(loop.convert("RGB").getpixel((24, 16))[0])
            durations.append(loop.info["duration"])
    # Frames 0, 3, 6 and 9 of the film, 12 levels apart; WebP is lossy, and a GIF has 256 colours.
    assert reds == pytest.approx([160, 172, 184, 196], abs=6)
    assert sum(durations) == 200


def test_a_part_of_a_film_can_be_looped(tmp_path):
    red = film(tmp_path / "red", (100, 20, 20), frames=8, step=16)
    arguments = ("--from", 4, "--until", 6, "--fps", 60, "-o", tmp_path / "red.webp")
    assert pipeline("loop", red, *arguments).exit_code == 0
    with Image.open(tmp_path / "red.webp") as loop:
        assert (loop.n_frames, loop.size) == (3, SIZE)
        assert loop.convert("RGB").getpixel((24, 16))[0] == pytest.approx(164, abs=6)


@pytest.mark.parametrize(
    ("arguments", "name", "sentence"),
    [
        ((), "red.mov", '".mov" is no loop; use .webp or .gif'),
        ((), "red.gif", "of the frames 0-11 of red only 0-7 are rendered; choose with --until"),
        (("--from", 3, "--until", 2), "red.gif", "red has the frames 0-11, not 3-2"),
        (("--until", 7, "--fps", 60), "red.gif", "a GIF has at most 50 frames a second, not 60"),
    ],
)
def test_what_cannot_be_looped_is_told(tmp_path, arguments, name, sentence):
    red = film(tmp_path / "red", (160, 20, 20), frames=8)
    result = pipeline("loop", red, *arguments, "-o", tmp_path / name)
    assert result.exit_code == 1
    assert sentence in result.stderr
    assert not (tmp_path / name).exists()


def test_frames_of_a_longer_film_that_was_there_before_are_not_shown(tmp_path):
    films = [film(tmp_path / name, (100, 20, 20), frames=6, planned=3) for name in ("a", "b")]
    result = pipeline("compare", *films, "-o", tmp_path / "new folder" / "both.mp4")
    assert result.exit_code == 0, result.output
    assert len(decode(tmp_path / "new folder" / "both.mp4")[0]) == 3


def test_a_place_that_is_no_folder_is_told_in_a_line(tmp_path):
    films = [film(tmp_path / name, (100, 20, 20), frames=3, planned=3) for name in ("a", "b")]
    (tmp_path / "file").write_text("")
    result = pipeline("compare", *films, "-o", tmp_path / "file" / "both.mp4")
    assert result.exit_code == 1
    assert "cannot make" in result.output
