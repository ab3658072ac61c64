"""Spray as tasks: what they are planned from, and what surface and drops make of frames in the cache."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import HELPERS, PROJECT
from planned_jobs import LAYOUT, concerned, planned
from test_whitewater_stage import FRAMES, JOB_FILE, OIL, TANK, write_cache

from blender_scripts.optics import per_metre
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.render_scene import render_spec
from pipeline.store.cache import read_frame, write_frame
from render.meshes import read_ply
from render.parameters import MaterialParameters
from render.point_clouds import read_point_cloud, validate_point_cloud
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport
from sim.whitewater.kinds import LiquidKind

RADIUS = 0.01


def job(**changes) -> Job:
    return Job.model_validate({**TANK, **changes}, strict=False)


# --- plan ----------------------------------------------------------------------------------------------------------


def test_a_frame_needs_the_fluid_and_the_kinds_before_and_the_surface_needs_its_kinds():
    tasks = planned(job())
    assert tasks["spray/water/000000"].inputs == ("cache/000000.h5",)
    assert tasks["spray/water/000003"].inputs == ("cache/000003.h5", "liquid/water/000002.h5")
    assert tasks["spray/water/000003"].outputs == ("liquid/water/000003.h5", "drops/water/000003.ply")
    assert tasks["surface/water/000003"].inputs == ("cache/000003.h5", "liquid/water/000003.h5")
    assert "drops/water/000003.ply" in tasks["render/000003"].inputs


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        ({"surface": {"drop_diameter": 1e-3}}, {"spray"}),
        ({"surface": {"threshold": 0.5}}, {"surface"}),
        ({"fluid": [{**TANK["fluid"][0], "viscosity": 1e-3}]}, {"simulate", "spray"}),
        ({"frames": 80}, set()),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else str(value),
)
def test_a_change_concerns_only_the_stages_that_read_it(change, stages):
    assert concerned(job(), job(**change)) == stages


@pytest.mark.parametrize(("look", "drawn"), [("water", "drops"), ("honey", "drops"), ("milk", "milk")])
def test_drops_of_clear_liquids_have_a_look_of_their_own_and_those_of_others_look_like_them(look, drawn):
    objects = {each.name: each for each in render_spec(job(material={"water": {"look": look}}), LAYOUT).objects}
    assert objects["water.drops"].material.look == drawn
    assert objects["water.drops"].file == "drops/water/{frame}.ply"


def drawn(name: str, **materials: dict) -> MaterialParameters:
    return {each.name: each for each in render_spec(job(material=materials), LAYOUT).objects}[name].material


def test_drops_of_a_clear_liquid_have_the_colour_of_light_through_one_of_them():
    wine = drawn("water", water={"look": "wine", "density": 1.0})
    red, green, blue = drawn("water.drops", water={"look": "wine", "density": 1.0}).color
    spec, fluid = job(), job().fluid[0]
    # Half as many drops as a particle may have, <d³> = 1.875 <d>³ of each.
    diameter = 2.0 * fluid.particle_radius * (12.0 / np.pi / 1.875 / spec.surface.drops_per_particle) ** (1.0 / 3.0)
    assert diameter > spec.surface.drop_diameter
    mean_chord = 2.0 / 3.0 * diameter
    thin = np.exp(-mean_chord * np.array(per_metre("wine", wine.density)))
    assert red == pytest.approx(thin[0], rel=0.02)  # where little is absorbed the chord's mean is all that counts
    assert green < blue < 0.7 < red
    own = drawn("water.drops", water={"look": "wine"}, **{"water.drops": {"color": (0.1, 0.2, 0.3)}})
    assert own.color == (0.1, 0.2, 0.3)


def test_drops_go_from_the_colour_of_the_liquid_to_that_of_its_dye():
    look, red = {"look": "water", "density": 900.0, "color": (0.99, 0.99, 0.99)}, (0.9, 0.05, 0.1)
    dyed = drawn("water.drops", water={**look, "dye_color": red})
    assert dyed.color == drawn("water.drops", water=look).color
    assert dyed.dye_color == pytest.approx(drawn("water.drops", water={**look, "color": red}).color, rel=1e-4)
    milk = drawn("water.drops", water={"look": "milk", "dye_color": (0.9, 0.05, 0.1)})
    assert milk.dye_color == (0.9, 0.05, 0.1)


def test_drops_of_a_cloudy_liquid_are_as_the_job_says():
    said = drawn(
        "water.drops", water={"look": "milk"}, **{"water.drops": {"look": "plastic", "color": (0.1, 0.2, 0.3)}}
    )
    assert (said.look, said.color) == ("plastic", (0.1, 0.2, 0.3))
    rough = drawn("water.drops", water={"look": "milk"}, **{"water.drops": {"roughness": 0.4}})
    assert (rough.look, rough.roughness) == ("milk", 0.4)


# --- run -----------------------------------------------------------------------------------------------------------

CHAIN = f"""
import sys
sys.path[:0] = [{str(HELPERS)!r}, {str(Path(__file__).parent)!r}]
from pathlib import Path
from pipeline.base.layout import JobLayout
from test_spray_stage import run
print(run(JobLayout(Path(sys.argv[1])), sys.argv[2].split(","), int(sys.argv[3])))
"""


def run(layout: JobLayout, names: list[str], threads: int) -> list[object]:
    """Run these tasks in this process; returns how each ended."""
    from inline_tasks import run_task

    tasks = {task.id: task for task in plan_job(load_job(layout.job_file), layout, STAGES)}
    return [run_task(tasks[name], layout, threads=threads if "spray" in name else 1) for name in names]


def run_in_a_process(layout: JobLayout, names: list[str], *, threads: int = 2) -> str:
    """Run tasks in a process of their own, as no other Taichi of this one may have another number of threads."""
    command = [sys.executable, "-c", CHAIN, str(layout.root), ",".join(names), str(threads)]
    return subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True, timeout=300).stdout


def names_of(stage: str, frames: range, body: str = "water") -> list[str]:
    return [f"{stage}/{body}/{frame:06d}" for frame in frames]


def write_splash(layout: JobLayout, names: tuple[str, ...] = ("water",)) -> None:
    """A block at rest beside the ball, a film that flies up from it, and lone particles about it."""
    axes = [np.arange(0.0, 0.19, 0.02) + 0.2, np.arange(0.0, 0.19, 0.02), np.arange(0.0, 0.09, 0.02) + 0.01]
    block = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    across = [np.arange(0.0, 0.19, 0.024) + 0.2, np.array([0.1]), np.arange(0.0, 0.19, 0.024) + 0.11]
    film = np.stack(np.meshgrid(*across, indexing="ij"), axis=-1).reshape(-1, 3)
    random = np.random.default_rng(1)
    lone = random.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 0.9], (40, 3))
    position = np.concatenate([block, film, lone])
    velocity = np.zeros_like(position)
    velocity[len(block) : len(block) + len(film), 2] = 0.2
    velocity[-len(lone) :] = random.normal(0, 1.5, lone.shape)
    still = {"position": np.array([0, 0, 0.2]), "orientation": np.array([1.0, 0, 0, 0])}
    ball = Snapshot("rigid", still | {"velocity": np.zeros(3), "angular_velocity": np.zeros(3)}, {})
    for frame in range(FRAMES):
        water = Snapshot(
            "fluid",
            {
                "position": (position + velocity * frame / 60).astype(np.float32),
                "velocity": velocity.astype(np.float32),
                "density": np.full(len(position), 1000.0, np.float32),
                "particle_id": np.arange(len(position), dtype=np.int32),
            },
            {"particle_radius": RADIUS, "rest_density": 1000.0},
        )
        path = layout.path(layout.frame_cache(frame))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_frame(path, {"ball": ball, "water": water}, FrameReport(frame, frame / 60, {}, {}, {}), device="cpu")


@pytest.fixture(scope="module")
def splash(tmp_path_factory) -> JobLayout:
    """A job whose spray and surfaces are made."""
    layout = JobLayout(tmp_path_factory.mktemp("spray") / "tank")
    write_splash(layout)
    layout.job_file.write_text(JOB_FILE)
    printed = run_in_a_process(
        layout, [*names_of("spray", range(FRAMES)), "surface/water/000000", "surface/water/000007"]
    )
    assert printed.count("Finished") == FRAMES + 2, printed
    return layout


def enclosed_volume(layout: JobLayout, frame: int) -> float:
    mesh = read_ply(layout.path(layout.surface("water", frame)))
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("frame", [0, 7])
def test_mesh_and_drops_have_the_volume_of_the_particles(splash, frame):
    cloud = read_point_cloud(splash.path(splash.drops("water", frame)))
    drops = 4.0 / 3.0 * np.pi * (cloud.radius.astype(np.float64) ** 3).sum()
    particles = read_frame(splash.path(splash.frame_cache(frame)), "water").bodies["water"].arrays["particle_id"]
    simulated = len(particles) * (2.0 * RADIUS) ** 3
    assert drops > 0.02 * simulated
    assert enclosed_volume(splash, frame) + drops == pytest.approx(simulated, rel=0.02)


def test_lone_particles_are_drops_outside_of_the_ball_and_in_no_mesh(splash):
    clouds = [read_point_cloud(splash.path(splash.drops("water", frame))) for frame in range(FRAMES)]
    for frame, cloud in enumerate(clouds):
        validate_point_cloud(splash.path(splash.drops("water", frame)))
        assert np.linalg.norm(cloud.position - [0.0, 0.0, 0.2], axis=1).min() > 0.1 - 1e-3
        assert cloud.radius.max() < RADIUS
    kinds = read_frame(splash.path(splash.liquid("water", 7)), "water").bodies["water"].arrays["liquid"]
    assert (kinds[-40:] == LiquidKind.SPRAY).sum() > 35
    assert (kinds[:500] == LiquidKind.SPRAY).sum() == 0
    assert (kinds[500:-40] == LiquidKind.SHEET).sum() > 30
    mesh = read_ply(splash.path(splash.surface("water", 7)))
    assert mesh.vertices[:, 2].max() < 0.4


def test_frames_that_are_gone_are_made_again_with_the_same_bits_by_any_number_of_threads(splash, tmp_path):
    """As after a crash: another process continues from the last frame that is left."""
    copy = JobLayout(Path(shutil.copytree(splash.root, tmp_path / "tank")))
    made = [place("water", frame) for frame in (4, 5, 6, 7) for place in (copy.liquid, copy.drops)]
    for artifact in made:
        copy.path(artifact).unlink()
        copy.receipt(artifact).unlink()
    assert run_in_a_process(copy, names_of("spray", range(4, 8)), threads=1).count("Finished") == 4
    for artifact in made:
        assert copy.path(artifact).read_bytes() == splash.path(artifact).read_bytes()


def test_drops_have_the_dye_of_the_particle_that_they_are_of(splash, tmp_path):
    copy = JobLayout(tmp_path / "tank")
    shutil.copytree(splash.root / "cache", copy.root / "cache")
    copy.job_file.write_text(splash.job_file.read_text())
    path = copy.path(copy.frame_cache(0))
    bodies = read_frame(path).bodies
    water = bodies["water"].arrays
    dye = np.random.default_rng(2).uniform(size=len(water["position"])).astype(np.float32)
    bodies["water"] = Snapshot("fluid", water | {"dye": dye}, bodies["water"].attributes)
    write_frame(path, bodies, FrameReport(0, 0.0, {}, {}, {}), device="cpu")
    assert run_in_a_process(copy, names_of("spray", range(1))).count("Finished") == 1
    drops = read_point_cloud(copy.path(copy.drops("water", 0)))
    owner = np.array([np.flatnonzero(dye == each).item() for each in drops.dye])
    assert len(set(owner.tolist())) > 20
    assert np.linalg.norm(drops.position - water["position"][owner], axis=1).max() < 5.0 * RADIUS


def test_without_drops_every_particle_is_of_the_surface(splash, tmp_path):
    copy = JobLayout(tmp_path / "tank")
    shutil.copytree(splash.root / "cache", copy.root / "cache")
    copy.job_file.write_text(JOB_FILE + "[surface]\ndrops_per_particle = 0\n")
    assert run_in_a_process(copy, [*names_of("spray", range(1)), *names_of("surface", range(1))]).count("Finished") == 2
    assert len(read_point_cloud(copy.path(copy.drops("water", 0))).position) == 0
    assert read_ply(copy.path(copy.surface("water", 0))).vertices[:, 2].max() > 0.6


@pytest.mark.parametrize("is_alone", [False, True])
def test_a_piece_that_another_fluid_surrounds_is_no_spray(is_alone, tmp_path):
    """A cube of eight particles of oil, within a jet of water or in the air above it."""
    layout = JobLayout(tmp_path / "tank")
    write_cache(layout, second_jet="oil")
    layout.job_file.write_text(JOB_FILE.replace("[whitewater", OIL + "[whitewater"))
    path = layout.path(layout.frame_cache(0))
    bodies = read_frame(path).bodies
    water = bodies["water"].arrays
    middle = np.median(water["position"], axis=0)
    few = np.zeros(len(water["position"]), bool)
    few[np.argsort(np.linalg.norm(water["position"] - middle, axis=1), kind="stable")[:8]] = True
    oil = {key: array[few].copy() for key, array in water.items()}
    oil["position"] += np.float32([0.0, 0.0, 0.3 * is_alone])
    water = {key: array[~few] for key, array in water.items()}
    for name, arrays in (("water", water), ("oil", oil)):
        bodies[name] = Snapshot("fluid", arrays, bodies[name].attributes)
    write_frame(path, bodies, FrameReport(0, 0.0, {}, {}, {}), device="cpu")
    assert run_in_a_process(layout, ["spray/oil/000000"]).count("Finished") == 1
    kinds = read_frame(layout.path(layout.liquid("oil", 0)), "oil").bodies["oil"].arrays["liquid"]
    assert (kinds == LiquidKind.SPRAY).tolist() == [is_alone] * 8


@pytest.mark.parametrize("is_near", [True, False])
def test_drops_within_another_fluid_are_of_the_surface(is_near, tmp_path):
    """Lone particles of oil that fly beside a jet of water, close by or far from it."""
    layout = JobLayout(tmp_path / "tank")
    write_cache(layout, second_jet="oil")
    layout.job_file.write_text(JOB_FILE.replace("[whitewater", OIL + "[whitewater"))
    for frame in range(FRAMES):
        path = layout.path(layout.frame_cache(frame))
        bodies = read_frame(path).bodies
        water = bodies["water"].arrays["position"]
        oil = {key: array[:5].copy() for key, array in bodies["oil"].arrays.items()}
        # Farther from each other and from the jet than what hangs together.
        beside = [np.median(water[:, 0]), np.median(water[:, 1]), water[:, 2].max() + 0.032 + 0.3 * (not is_near)]
        oil["position"] = np.float32(beside) + np.float32([0.04, 0.0, 0.0]) * (
            np.arange(5, dtype=np.float32)[:, None] - 2
        )
        oil["velocity"] = bodies["water"].arrays["velocity"][:5].copy()
        bodies["oil"] = Snapshot("fluid", oil, bodies["oil"].attributes)
        write_frame(path, bodies, FrameReport(frame, frame / 60, {}, {}, {}), device="cpu")
    assert run_in_a_process(layout, names_of("spray", range(FRAMES), "oil")).count("Finished") == FRAMES
    kinds = read_frame(layout.path(layout.liquid("oil", 7)), "oil").bodies["oil"].arrays["liquid"]
    assert (kinds == LiquidKind.SPRAY).all()
    cloud = read_point_cloud(layout.path(layout.drops("oil", 7)))
    drops = 4.0 / 3.0 * np.pi * (cloud.radius.astype(np.float64) ** 3).sum() / (5 * (2.0 * RADIUS) ** 3)
    assert np.linalg.norm(cloud.position[:, None] - water[None], axis=2).min() > RADIUS
    assert (0.2 < drops < 0.95) if is_near else drops == pytest.approx(1.0, rel=1e-5)
