"""Whitewater as tasks: what they are planned from, and what they make of frames in the cache."""

import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from inline_tasks import run_task
from places import HELPERS, PROJECT
from planned_jobs import LAYOUT, concerned, digests, first_of, planned

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.checked_job import check_job
from pipeline.run.events import Finished, TaskEvent
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.render_scene import render_spec
from pipeline.stages.whitewater import CORES
from pipeline.store.cache import write_frame
from render.point_clouds import read_point_cloud, validate_point_cloud
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

FRAMES = 8

TANK = {
    "name": "tank",
    "frames": FRAMES,
    "device": "cpu",
    "rigid": [{"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "position": [0.0, 0.0, 0.2]}],
    "fluid": [{"name": "water", "block": [{"shape": {"type": "box", "size": [0.2, 0.2, 0.2]}}]}],
    "whitewater": {"water": {}},
}


def job(**changes) -> Job:
    return Job.model_validate({**TANK, **changes}, strict=False)


def points_of(of: Job) -> list[str]:
    return [each.name for each in render_spec(of, LAYOUT).objects if each.type == "point_sequence"]


# --- plan ----------------------------------------------------------------------------------------------------------


def test_a_frame_needs_the_one_before_and_the_fluid_at_both():
    tasks = planned(job())
    assert tasks["whitewater/water/000000"].inputs == ("cache/000000.h5",)
    assert tasks["whitewater/water/000003"].inputs == (
        "cache/000002.h5",
        "cache/000003.h5",
        "whitewater/water/000002.ply",
    )
    assert "whitewater/water/000003.ply" in tasks["render/000003"].inputs


def test_without_its_table_there_is_no_task_and_no_change_to_the_pictures():
    without = job(whitewater={})
    assert "whitewater" not in digests(without)
    assert points_of(without) == ["water.drops"]


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        ({"whitewater": {"water": {"lifetime_max": 4.0}}}, {"whitewater"}),
        ({"gravity": [0, 0, -1.62]}, {"simulate", "whitewater"}),
        ({"material": {"water.foam": {"look": "foam", "color": (0.9, 0.8, 0.7)}}}, {"render"}),
        ({"surface": {"threshold": 0.5}}, {"surface"}),
        ({"fluid": [{**TANK["fluid"][0], "viscosity": 1e-3}]}, {"simulate", "spray"}),
        ({"frames": 80}, set()),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else str(value),
)
def test_a_change_concerns_only_the_stages_that_read_it(change, stages):
    assert concerned(job(), job(**change)) == stages


def test_the_memory_claim_counts_the_fluids_and_the_cloud():
    ball = {"shape": {"type": "sphere", "radius": 0.1}}

    def claim(fluid_particles: int, cloud: int) -> int:
        of = job(
            domain={"min": [-10, -10, 0], "max": [10, 10, 20]},
            fluid=[{**TANK["fluid"][0], "block": [ball], "max_particles": fluid_particles}],
            whitewater={"water": {"max_particles": cloud}},
        )
        return first_of(of, "whitewater").resources.memory_bytes

    # Measured: 160 MB without any particles, 513 MB with a million of fluid, 1189 MB with 2,986,000.
    assert claim(2_986_000, 1) > 1_189_000_000
    assert claim(1_000_000, 1) - claim(1, 1) > 353_000_000 * 0.98
    assert claim(1, 1_000_000) > claim(1, 1)


def test_each_kind_is_drawn_with_a_look_of_its_own():
    assert points_of(job()) == ["water.drops", "water.spray", "water.foam", "water.bubbles"]
    objects = {each.name: each for each in render_spec(job(), LAYOUT).objects if each.name in points_of(job())[1:]}
    assert [each.material.look for each in objects.values()] == ["spray", "foam", "bubbles"]
    assert {each.file for each in objects.values()} == {"whitewater/water/{frame}.ply"}


def test_whitewater_of_a_fluid_that_is_not_there_is_refused():
    findings = check_job(job(whitewater={"watre": {}}))
    assert [problem.message for problem in findings.errors] == ['no fluid is named "watre"; did you mean "water"?']


def test_a_part_can_be_painted_only_where_there_is_whitewater():
    foam = {"water.foam": {"look": "foam"}}
    assert not check_job(job(material=foam)).errors
    assert check_job(job(material=foam, whitewater={})).errors


# --- run -----------------------------------------------------------------------------------------------------------


def write_cache(layout: JobLayout, *, second_jet: str = "water") -> None:
    """Two jets of fluid that meet above the ball, one moving on through the other; both of water, or of two fluids."""
    axes = [np.arange(-0.2, -0.01, 0.02), np.arange(-0.05, 0.05, 0.02), np.arange(0.45, 0.55, 0.02)]
    left = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    position = np.concatenate([left, left * [-1, 1, 1]])
    velocity = np.repeat([[2.5, 0, -1.0], [-2.5, 0, -1.0]], len(left), axis=0)
    rows = {"water": np.arange(len(left))}
    rows[second_jet] = np.append(rows.get(second_jet, rows["water"][:0]), np.arange(len(left), 2 * len(left)))
    still = {"position": np.array([0, 0, 0.2]), "orientation": np.array([1.0, 0, 0, 0])}
    ball = Snapshot("rigid", still | {"velocity": np.zeros(3), "angular_velocity": np.zeros(3)}, {})
    for frame in range(FRAMES):
        arrays = {
            "position": (position + velocity * frame / 60).astype(np.float32),
            "velocity": velocity.astype(np.float32),
            "density": np.full(len(position), 1000.0, np.float32),
            "particle_id": np.arange(len(position), dtype=np.int32),
        }
        fluids = {
            name: Snapshot(
                "fluid",
                {key: array[own] for key, array in arrays.items()},
                {"particle_radius": 0.01, "rest_density": 1000.0},
            )
            for name, own in rows.items()
        }
        path = layout.path(layout.frame_cache(frame))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_frame(path, {"ball": ball, **fluids}, FrameReport(frame, frame / 60, {}, {}, {}), device="cpu")


JOB_FILE = """
name = "tank"
frames = 8
device = "cpu"
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
[[fluid]]
name = "water"
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
[whitewater.water]
trapped_air_rate = 4000.0
"""


OIL = """
[[fluid]]
name = "oil"
[[fluid.block]]
shape = { type = "box", size = [0.1, 0.1, 0.1] }
"""


def run(layout: JobLayout, frames: Iterable[int]) -> list[TaskEvent]:
    """Run the tasks of these frames in this process; returns how each ended."""
    tasks = {task.id: task for task in plan_job(load_job(layout.job_file), layout, STAGES)}
    return [run_task(tasks[f"whitewater/water/{frame:06d}"], layout, threads=CORES) for frame in frames]


def contents(layout: JobLayout) -> list[bytes]:
    return [layout.path(layout.whitewater("water", frame)).read_bytes() for frame in range(FRAMES)]


CHAIN = f"""
import sys
sys.path[:0] = [{str(HELPERS)!r}, {str(Path(__file__).parent)!r}]
from pathlib import Path
from pipeline.base.layout import JobLayout
from test_whitewater_stage import run
print(run(JobLayout(Path(sys.argv[1])), map(int, sys.argv[2].split(","))))
"""


def run_in_a_process(layout: JobLayout, frames: str) -> str:
    """Run frames in a process of their own, as no other Taichi of this one may have another number of threads."""
    command = [sys.executable, "-c", CHAIN, str(layout.root), frames]
    return subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True, timeout=120).stdout


@pytest.fixture(scope="module")
def tank(tmp_path_factory) -> JobLayout:
    """A job whose whitewater is made."""
    layout = JobLayout(tmp_path_factory.mktemp("whitewater") / "tank")
    write_cache(layout)
    layout.job_file.write_text(JOB_FILE)
    printed = run_in_a_process(layout, ",".join(map(str, range(FRAMES))))
    assert printed.count("Finished") == FRAMES, printed
    return layout


def test_jets_that_meet_throw_up_whitewater(tank):
    clouds = []
    for frame in range(FRAMES):
        path = tank.path(tank.whitewater("water", frame))
        validate_point_cloud(path)
        clouds.append(read_point_cloud(path))
    counts = [len(cloud.position) for cloud in clouds]
    assert counts[0] == 0
    assert counts[-1] > 200
    last = clouds[-1]
    assert np.linalg.norm(last.position - [0.0, 0.0, 0.2], axis=1).min() > 0.1 - 1e-3  # as fine as the ball's grid
    log = tank.log(f"whitewater/water/{FRAMES - 1:06d}", 1).read_text()
    assert f"{counts[-1]} particles, " in log


def test_a_fluid_feels_the_other_fluids_of_its_tank(tmp_path):
    """Its jet alone moves as a whole and makes nothing; air is trapped where it meets the other one."""
    layout = JobLayout(tmp_path / "tank")
    write_cache(layout, second_jet="oil")
    with_oil = JOB_FILE.replace("[whitewater", OIL + "[whitewater") + "wave_crest_rate = 0.0\n"
    layout.job_file.write_text(with_oil)
    printed = run_in_a_process(layout, "0,1,2,3,4")
    assert printed.count("Finished") == 5, printed
    assert len(read_point_cloud(layout.path(layout.whitewater("water", 4))).position) > 20


def test_what_has_no_room_below_the_cap_is_told_by_the_file(tmp_path):
    layout = JobLayout(tmp_path / "tank")
    write_cache(layout)
    layout.job_file.write_text(JOB_FILE + "max_particles = 50\n")
    printed = run_in_a_process(layout, "0,1,2,3,4,5")
    assert printed.count("Finished") == 6, printed
    clouds = [read_point_cloud(layout.path(layout.whitewater("water", frame))) for frame in range(6)]
    assert clouds[0].not_made == 0
    assert len(clouds[-1].position) == 50
    assert clouds[-1].not_made > 0


def test_frames_that_are_gone_are_made_again_with_the_same_bits(tank, tmp_path):
    """As after a crash: another process continues from the last frame that is left."""
    copy = JobLayout(Path(shutil.copytree(tank.root, tmp_path / "tank")))
    for frame in (4, 5, 6, 7):
        for artifact in (copy.path(copy.whitewater("water", frame)), copy.receipt(copy.whitewater("water", frame))):
            artifact.unlink()
    assert run_in_a_process(copy, "4,5,6,7").count("Finished") == 4
    assert contents(copy) == contents(tank)


def test_a_frame_whose_predecessor_is_missing_fails_and_says_so(tank, tmp_path):
    copy = JobLayout(Path(shutil.copytree(tank.root, tmp_path / "tank")))
    copy.path(copy.whitewater("water", 3)).unlink()
    copy.receipt(copy.whitewater("water", 4)).unlink()
    copy.path(copy.whitewater("water", 4)).unlink()
    printed = run_in_a_process(copy, "4")
    assert "Failed" in printed
    assert "000003.ply" in printed


def test_the_first_frame_is_empty_and_needs_no_physics(tank, tmp_path):
    copy = JobLayout(Path(shutil.copytree(tank.root, tmp_path / "tank")))
    shutil.rmtree(copy.root / "whitewater")
    shutil.rmtree(copy.receipts)
    (ended,) = run(copy, [0])
    assert isinstance(ended, Finished)
    assert len(read_point_cloud(copy.path(copy.whitewater("water", 0))).position) == 0
