"""`pipeline sweep`: a job for each value, what they share made once, killed and continued, a sheet and a table."""

import csv
import errno
import os
import shutil
import signal
from collections.abc import Iterator

import pytest
from command_line import pipeline
from farm_processes import Farm, wait_until
from PIL import Image
from synthetic_stages import step_artifact

from pipeline.base.layout import JobLayout
from pipeline.run.sharing import read_siblings, write_siblings
from pipeline.store.artifacts import take_over
from pipeline.store.receipts import read_receipt, verify_artifact

CAMERAS = ("--set", "camera.focal_length_mm=35,50")
GRAVITIES = ("--set", "gravity=[0,0,-9.81],[0,0,-1.62]")
NEAR, FAR = "a-focal_length_mm-35", "a-focal_length_mm-50"


@pytest.fixture
def farm(tmp_path) -> Iterator[Farm]:
    farm = Farm(tmp_path)
    yield farm
    farm.close()


def steps_taken(farm: Farm, name: str) -> int:
    """How often the simulation of a job really ran: attempts that are known from a receipt took no time here."""
    return sum(row.task == "steps" and row.seconds is not None for row in farm.attempts(name))


def inodes(layout: JobLayout, pattern: str) -> list[int]:
    return [path.stat().st_ino for path in sorted(layout.root.glob(pattern))]


def test_a_sweep_over_the_camera_simulates_once(farm):
    farm.job("a")
    farm.here("sweep", "a.toml", *CAMERAS)
    assert (steps_taken(farm, NEAR), steps_taken(farm, FAR)) == (1, 0)
    near, far = farm.layout(NEAR), farm.layout(FAR)
    assert inodes(near, "steps/*.bin") == inodes(far, "steps/*.bin")
    assert not set(inodes(near, "double/*.bin")) & set(inodes(far, "double/*.bin"))
    assert "0 not as committed" in farm.here("verify", FAR, "--deep").out


def test_a_sweep_over_the_physics_shares_nothing(farm):
    farm.job("a")
    farm.here("sweep", "a.toml", *GRAVITIES)
    names = sorted(path.parent.name for path in farm.queue.farm.glob("*/job.toml"))
    assert [steps_taken(farm, name) for name in names] == [1, 1]


def test_what_is_removed_or_edited_in_one_job_stays_in_the_others(farm):
    farm.job("a")
    farm.here("sweep", "a.toml", *CAMERAS)
    before = {path.name: path.read_bytes() for path in farm.layout(FAR).root.glob("steps/*.bin")}
    farm.here("clean", NEAR, "--stage", "steps", "--yes")
    assert not inodes(farm.layout(NEAR), "steps/*.bin")
    assert {path.name: path.read_bytes() for path in farm.layout(FAR).root.glob("steps/*.bin")} == before
    # The same command brings it back, from the other one.
    farm.here("sweep", "a.toml", *CAMERAS)
    assert inodes(farm.layout(NEAR), "steps/*.bin") == inodes(farm.layout(FAR), "steps/*.bin")
    assert steps_taken(farm, NEAR) == 1
    shutil.rmtree(farm.layout(NEAR).root)
    assert "0 not as committed" in farm.here("verify", FAR, "--deep").out


def test_a_sweep_that_was_killed_goes_on_where_it_stopped(farm):
    farm.job("a", frames=12)
    for name in (NEAR, FAR):
        farm.faults(name, {}, pause_s=0.1)
    process = farm.start("sweep", "a.toml", *CAMERAS)
    wait_until(lambda: farm.frames_done(NEAR) >= 2, "no frame was made")
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    wait_until(lambda: not farm.is_running(NEAR), "the killed run still holds the job")
    near = farm.layout(NEAR)
    # A file without a receipt, as the kill may have left one, is none.
    made = [near.path(step_artifact(k)) for k in range(12) if read_receipt(near, step_artifact(k)) is not None]
    before = [path.stat().st_ino for path in made]
    assert before
    farm.here("sweep", "a.toml", *CAMERAS)
    assert [path.stat().st_ino for path in made] == before
    assert farm.frames_done(NEAR) == farm.frames_done(FAR) == 12
    assert steps_taken(farm, FAR) == 0
    assert all((farm.layout(name).root / "film.bin").is_file() for name in (NEAR, FAR))
    assert farm.here("sweep", "a.toml", *CAMERAS).err.count("finished already") == 2


def test_a_detached_sweep_shares_as_well(farm):
    farm.job("a")
    assert "without --detach" in farm.run("sweep", "a.toml", *CAMERAS, "--detach").err
    wait_until(lambda: farm.frames_done(FAR) == 6 and farm.settled(FAR), "the queue did not make the last job")
    assert (steps_taken(farm, NEAR), steps_taken(farm, FAR)) == (1, 0)


def test_a_dry_run_names_the_jobs_and_makes_nothing(farm):
    farm.job("a")
    shutil.rmtree(farm.queue.farm, ignore_errors=True)
    told = farm.here("sweep", "a.toml", *CAMERAS, *GRAVITIES, "--dry-run").out
    assert told.count("a-focal_length_mm-") == 4
    assert "4 jobs:" in told
    assert "12 files shared with a job before" in told  # six steps of each of two gravities
    assert not farm.queue.farm.exists()


def test_all_that_is_wrong_with_all_jobs_is_told_at_once(farm):
    farm.job("a")
    told = farm.here("sweep", "a.toml", "--set", "gravty=[0,0,1],[0,0,2]", "--set", "camera.focal=3,4", code=2)
    assert told.err.count('no key "gravty"') == 1
    assert told.err.count('no key "focal"') == 1
    told = farm.here("sweep", "a.toml", "--set", "frames=0,2", "--set", "fps=-1,5", code=2)
    assert "frames" in told.err
    assert "fps" in told.err


def test_files_are_copied_where_there_are_no_hard_links(farm, tmp_path, monkeypatch):
    farm.job("a")
    farm.here("submit", "a.toml")

    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, "two disks")

    monkeypatch.setattr(os, "link", refuse)
    owner, layout = farm.layout("a"), JobLayout(tmp_path / "renders" / "b")
    layout.root.mkdir()
    receipt = read_receipt(owner, step_artifact(0))
    assert receipt is not None
    take_over(layout, receipt, owner)
    taken = read_receipt(layout, step_artifact(0))
    assert taken == receipt
    assert verify_artifact(layout, receipt, deep=True) is None
    assert layout.path(step_artifact(0)).stat().st_ino != owner.path(step_artifact(0)).stat().st_ino


@pytest.mark.parametrize("loses", [lambda path: path.unlink(), lambda path: path.write_bytes(b"made anew")])
def test_what_another_job_removes_or_makes_anew_meanwhile_is_made_here(farm, tmp_path, monkeypatch, loses):
    farm.job("a")
    farm.here("submit", "a.toml")
    owner, layout = farm.layout("a"), JobLayout(tmp_path / "renders" / "b")
    layout.root.mkdir()
    receipt = read_receipt(owner, step_artifact(0))
    assert receipt is not None
    loses(owner.path(step_artifact(0)))
    with pytest.raises(FileNotFoundError):
        take_over(layout, receipt, owner)
    assert read_receipt(layout, step_artifact(0)) is None
    assert [path for path in layout.path(step_artifact(0)).parent.iterdir() if path.is_file()] == []


def test_siblings_lie_beside_a_job_and_nowhere_else(tmp_path):
    layout = JobLayout(tmp_path / "a")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    write_siblings(layout, ["a", "b", "gone"])
    assert [each.root.name for each in read_siblings(layout)] == ["b"]
    (tmp_path / "c").mkdir()
    write_siblings(layout, ["a", "c"])  # the sweep has other values now
    assert [each.root.name for each in read_siblings(layout)] == ["b", "c"]
    for text in ("", "[]", '{"jobs": 3}', '{"jobs": ["../b", "/etc", ".."]}', "[" * 200_000):
        layout.siblings.write_text(text)
        assert read_siblings(layout) == []


def test_a_real_sweep_ends_with_a_sheet_and_a_table(tmp_path):
    job = tmp_path / "drop.toml"
    job.write_text(
        """
name = "drop"
frames = 2
device = "cpu"
[domain]
min = [-0.3, -0.3, 0.0]
max = [0.3, 0.3, 0.6]
[[fluid]]
name = "water"
particle_radius = 0.03
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.0, 0.3]
[render]
resolution = [96, 54]
quality = "draft"
samples = 1
"""
    )
    result = pipeline(
        "sweep", job, "--set", "camera.position=[0,-1.5,0.5],[1.1,-1.1,0.8]", "--farm", tmp_path / "renders"
    )
    assert result.exit_code == 0, result.output
    with Image.open(tmp_path / "renders" / "drop-position-sweep.png") as sheet:
        assert sheet.width > 2 * 96  # two frames of each job in a row ...
        assert sheet.height > 2 * 54  # ... and a row for each
    with (tmp_path / "renders" / "drop-position-sweep.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["position"], line["frame"]) for line in lines] == [
        ("[0,-1.5,0.5]", "0"),
        ("[0,-1.5,0.5]", "1"),
        ("[1.1,-1.1,0.8]", "0"),
        ("[1.1,-1.1,0.8]", "1"),
    ]
    assert float(lines[0]["water.particle_count"]) > 0
    assert lines[0]["water.kinetic_energy"] == lines[2]["water.kinetic_energy"]  # it is the same simulation

    table = tmp_path / "renders" / "drop-position-sweep.csv"
    written = table.read_bytes()
    again = ("--dry-run", "--farm", tmp_path / "renders")
    refused = pipeline("sweep", job, "--set", "camera.position=[0,-1.5,0.5],[0,-2,0.5]", *again)
    assert refused.exit_code == 1
    assert "drop-position-sweep.csv is of another sweep, with drop-position-1.1_-1.1_0.8" in refused.stderr
    for setting in ("camera.position=[0,-1.5,0.5],[1.1,-1.1,0.8],[0,-2,0.5]", "camera.focal_length_mm=35,50"):
        assert pipeline("sweep", job, "--set", setting, *again).exit_code == 0
    assert table.read_bytes() == written
