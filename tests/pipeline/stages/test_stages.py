"""What the stages plan for a job, and what they tell Blender."""

from dataclasses import replace

import numpy as np
import pytest
from planned_jobs import LAYOUT, concerned, digests, first_of, parameters_of, planned
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from blender_scripts.look_table import LOOK_TABLE
from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.task import Resources
from pipeline.model.gpus import GPU_TASKS
from pipeline.model.job import Job
from pipeline.model.looks import parts_of
from pipeline.run.events import Start
from pipeline.run.plan import plan_job
from pipeline.run.scheduler import Scheduler
from pipeline.stages import STAGES
from pipeline.stages.movie import MovieStage
from pipeline.stages.render_scene import render_spec
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

TANK = {
    "name": "tank",
    "frames": 40,
    "device": "cpu",
    "rigid": [{"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "rotation_deg": [10, 20, 30]}],
    "fluid": [{"name": "water", "block": [{"shape": {"type": "box", "size": [0.2, 0.2, 0.2]}}]}],
    "smoke": [{"name": "plume", "source": [{"shape": {"type": "sphere", "radius": 0.1}}]}],
}


def job(**changes) -> Job:
    return Job.model_validate({**TANK, **changes}, strict=False)


def test_every_frame_gets_its_surface_volume_and_picture():
    stages = [task.stage for task in planned(job()).values()]
    count = {stage.name: stages.count(stage.name) for stage in STAGES if not stage.on_demand}
    assert count == {
        "bodies": 1,
        "simulate": 1,
        "spray": 40,
        "surface": 40,
        "cloth": 0,
        "animated": 0,
        "soft": 0,
        "volume": 40,
        "embers": 0,
        "whitewater": 0,
        "bounds": 0,
        "render": 40,
        "movie": 3,
    }


def test_a_picture_waits_for_its_own_frame_and_the_film_is_cut_every_half_second():
    tasks = planned(job())
    assert tasks["render/000007"].inputs == (
        "meshes/ball.ply",
        "surfaces/water/000007.ply",
        "volumes/plume/000007.vdb",
        "drops/water/000007.ply",
    )
    assert [len(tasks[f"movie/segment-{index:04d}"].inputs) for index in (0, 1)] == [30, 10]
    assert tasks["movie/film"].inputs == ("movie/0000.mp4", "movie/0001.mp4")


def test_masters_lie_beside_the_pictures_of_the_film_and_a_film_for_editing_is_a_quicktime_film():
    tasks = planned(job(render={"format": "exr"}, movie={"codec": "prores"}))
    assert tasks["render/000007"].outputs == ("frames/000007.png", "frames/000007.exr")
    assert tasks["movie/segment-0000"].inputs[7] == "frames/000007.png"
    assert tasks["movie/film"].inputs == ("movie/0000.mov", "movie/0001.mov")
    assert tasks["movie/film"].outputs == ("movie.mov",)


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"render": {"passes": ["depth"]}}, 'passes need format = "exr"'),
        ({"render": {"format": "exr", "passes": ["vector"]}}, '"vector" needs motion_blur = false'),
        ({"render": {"format": "exr", "passes": ["depth", "depth"]}}, "one of them twice"),
        ({"movie": {"codec": "prores", "crf": 10}}, "crf has no meaning for prores"),
        ({"movie": {"codec": "prores", "preset": "slow"}}, "preset has no meaning for prores"),
        ({"movie": {"codec": "h265", "crf": 52}}, "crf of h265 is at most 51, got 52"),
    ],
)
def test_passes_and_keys_without_a_meaning_are_refused(tables, sentence):
    with pytest.raises(ValidationError, match=sentence):
        job(**tables)


def test_what_changes_no_pixel_runs_no_frame_again():
    def render(**tables: object) -> str:
        return digests(job(**tables))["render"]

    passes = [{"render": {"format": "exr", "passes": each}} for each in (["depth", "normal"], ["normal", "depth"])]
    assert render(**passes[0]) == render(**passes[1])
    assert render(set={"rotation_deg": 30.0}) == render()  # there is no picture to turn
    assert render(material={"ball": {"look": "metal", "caustics": True}}) == render(
        material={"ball": {"look": "metal"}}
    )
    assert render(material={"ball": {"look": "glass", "caustics": True}}) != render(
        material={"ball": {"look": "glass"}}
    )


def test_the_film_of_a_folder_is_the_one_that_its_job_asks_for(tmp_path):
    layout = JobLayout(tmp_path)
    assert layout.film == tmp_path / "movie.mp4"
    for name in ("movie.mp4", "movie.mov"):  # the last one made is not what counts
        (tmp_path / name).touch()
    layout.job_file.write_text('name = "tank"\n[movie]\ncodec = "prores"\n')
    assert layout.film == tmp_path / "movie.mov"
    layout.job_file.write_text('name = "tank"\n')
    assert layout.film == tmp_path / "movie.mp4"


def test_an_encoder_that_is_not_there_is_told_before_any_work(monkeypatch):
    monkeypatch.setattr("pipeline.stages.movie.missing_encoder", lambda _codec: "libx265")
    (told,) = MovieStage().preflight(job(movie={"codec": "h265"}))
    assert told.startswith('"h265" needs the encoder libx265')


@pytest.mark.parametrize(
    ("change", "stages"),
    [
        ({"camera": {"position": [0, -3, 1]}}, {"render"}),
        ({"material": {"ball": {"look": "metal"}}}, {"render"}),
        ({"movie": {"crf": 20}}, {"movie"}),
        ({"movie": {"crf": 16}}, set()),
        ({"movie": {"codec": "h265"}}, {"movie"}),
        ({"render": {"format": "exr"}}, {"render"}),
        ({"render": {"format": "png"}}, set()),
        ({"render": {"order": "spread"}}, set()),
        ({"surface": {"threshold": 0.5}}, {"surface"}),
        ({"gravity": [0, 0, -1.62]}, {"simulate"}),
        ({"frames": 80}, set()),
        ({"name": "other"}, set()),
        ({"render": {"device": "cpu"}}, {"render"}),
        ({"render": {"shutter": 0.25}}, {"render", "volume"}),
        ({"fps": 30}, {"simulate", "spray", "volume", "render", "movie"}),
        ({"set": {"background": "set", "rotation_deg": 0.0}}, set()),
        ({"set": {"name": "window"}}, {"render"}),
        ({"set": {"sun_elevation_deg": 38.0}}, set()),
        ({"set": {"sun_elevation_deg": 20.0}}, {"render"}),
        ({"set": {"sun_azimuth_deg": 0.0}}, {"render"}),
        ({"material": {"water": {"look": "water", "caustics": True}}}, {"render"}),
        ({"material": {"water": {"look": "water", "caustics": False}}}, set()),
        ({"set": {"ground": "wood"}}, {"render"}),
        ({"set": {"background": "plain"}}, {"render"}),
        ({"set": {"background": "transparent"}}, {"render"}),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else str(value),
)
def test_a_change_concerns_only_the_stages_that_read_it(change, stages):
    assert concerned(job(), job(**change)) == stages


def test_a_clear_fluid_tells_where_it_touches_solids_and_nothing_else_does():
    shape = {"type": "rectangle", "size": [0.2, 0.2], "counts": [5, 5]}
    cloth = [{"name": "flag", "material": "cotton", "shape": shape, "position": [0.0, 0.0, 0.8]}]
    for look, reach in ((None, 0.015), ("honey", 0.015), ("milk", None)):
        table = {} if look is None else {"material": {"water": {"look": look}}}
        fluid = [{**TANK["fluid"][0], "particle_radius": 0.01}]
        tank = job(fluid=fluid, cloth=cloth, **table)
        drawn = {each.name: each for each in render_spec(tank, LAYOUT).objects}
        assert drawn["water"].wets_within == reach
        assert drawn["flag"].wets_within is None


def test_milk_in_a_glass_tells_where_it_touches_it():
    tank = job(material={"water": {"look": "milk"}, "ball": {"look": "glass"}})
    drawn = {each.name: each for each in render_spec(tank, LAYOUT).objects}
    assert drawn["water"].wets_within == 1.5 * tank.fluid[0].particle_radius


@pytest.mark.parametrize("look", ["honey", "metal"])
def test_a_look_counts_with_its_revision(look, monkeypatch):
    tank = job(material={"ball": {"look": look}})
    before = digests(tank)
    monkeypatch.setitem(LOOK_TABLE, look, replace(LOOK_TABLE[look], revision=99))
    assert {stage for stage, digest in digests(tank).items() if digest != before[stage]} == {"render"}


@pytest.mark.parametrize(
    ("faces", "is_seen", "kept"),
    [
        (["z+", "z-"], True, []),
        (["x+", "z+"], False, []),
        (["y-", "x+", "z+"], True, ["x+", "y-"]),
    ],
)
def test_open_faces_count_for_pictures_only_where_a_pane_is_left_out(faces, is_seen, kept):
    tank = job(domain={"open_faces": faces}, set={"tank": is_seen})
    assert render_spec(tank, LAYOUT).open_faces == tuple(faces)
    assert parameters_of(tank, "render")["open_faces"] == kept


def test_lights_have_the_power_that_is_usual_for_their_type():
    place = {"position": [1, 0, 1]}
    lights = parameters_of(job(light=[place, place | {"type": "point"}, place | {"type": "sun"}]), "render")["lights"]
    assert [light["power"] for light in lights] == [100.0, 100.0, 5.0]


@pytest.mark.parametrize("angles", [(0, 0, 0), (90, 0, 0), (10, 20, 30), (-35, 120, 200)])
def test_blender_turns_a_body_as_the_simulation_does(angles):
    spec = render_spec(job(rigid=[{**TANK["rigid"][0], "rotation_deg": angles}]), LAYOUT)
    w, x, y, z = spec.objects[0].orientation
    ours = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(ours, Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("device", ["cuda", "vulkan", "metal"])
def test_a_device_that_does_not_work_here_is_planned_all_the_same(monkeypatch, device):
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok"})
    needed = first_of(job(device=device), "simulate").resources
    assert (needed.cores, needed.gpus) == (1, 1)


def test_a_device_left_open_takes_the_resources_of_the_one_that_works(monkeypatch):
    def resources(devices: dict[str, str]) -> Resources:
        monkeypatch.setattr("sim.core.runtime.available_devices", lambda: devices)
        return first_of(job(device="auto"), "simulate").resources

    assert resources({"cpu": "ok"}) == Resources(cores=0)
    with_gpu = resources({"cpu": "ok", "cuda": "ok"})
    assert (with_gpu.cores, with_gpu.gpus) == (1, 1)


def test_frames_on_their_way_to_the_disk_are_counted_in_memory():
    def need(radius: float) -> int:
        ball = {"shape": {"type": "sphere", "radius": 0.1}}
        fluid = {"name": "water", "block": [ball], "particle_radius": radius}
        return first_of(job(device="cuda", fluid=[fluid]), "simulate").resources.memory_bytes

    particles = 1.0 / 0.01**3  # all that fit into the domain of 1 m³, as a ball's volume is not looked at
    assert need(0.005) - need(0.05) > 3 * 32 * 0.99 * particles  # three frames of 32 bytes a particle


@pytest.mark.parametrize(
    "domain", [{"min": (-5, -5, 0), "max": (5, 5, 5)}, {"min": (-0.1, -0.1, 0), "max": (0.1, 0.1, 0.2)}]
)
def test_smoke_is_counted_in_memory_by_its_own_box(domain):
    fog = {**TANK["smoke"][0], "cell_size": 0.01, "min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0)}

    def need(smoke: list[dict]) -> int:
        return first_of(job(device="cuda", fluid=[], domain=domain, smoke=smoke), "simulate").resources.memory_bytes

    # Of 100³ cells: five frames of five arrays, and less than ten of six.
    assert 5 * 5 * 4 * 100**3 < need([fog]) - need([]) < 10 * 6 * 4 * 100**3


def test_a_job_simulated_on_a_gpu_elsewhere_is_rendered_on_a_machine_without_one():
    tasks = plan_job(job(device="cuda"), LAYOUT, STAGES)
    done = {task.id for task in tasks if task.stage != "render"}
    scheduler = Scheduler(tasks, up_to_date=done, capacity=Resources(cores=2, gpus=GPU_TASKS))
    assert [each.task.stage for each in scheduler.start() if isinstance(each, Start)] == ["render"]


@pytest.mark.parametrize("resolution", [(480, 270), (1920, 1080), (3840, 2160)])
def test_many_cores_do_not_draw_more_than_the_memory_holds(resolution):
    """64 cores beside 8 GB: by cores alone, 32 frames would be drawn at once."""
    tasks = plan_job(job(render={"resolution": resolution}), LAYOUT, STAGES)
    capacity = Resources(cores=64, memory_bytes=8_000_000_000)
    ready = {task.id for task in tasks if task.stage in ("bodies", "simulate", "spray", "surface", "volume")}
    scheduler = Scheduler(tasks, up_to_date=ready, capacity=capacity)
    started = [each for each in scheduler.start() if isinstance(each, Start)]
    worker = 450e6 + 690 * resolution[0] * resolution[1]  # as measured: 538 MB at 480 x 270, 1880 MB at 1920 x 1080
    assert 1 <= len(started) < 32
    assert len(started) * worker <= capacity.memory_bytes
    assert scheduler.free.memory_bytes < started[0].task.resources.memory_bytes  # and no fewer than it holds


def test_how_finely_spray_is_drawn_concerns_no_surface_by_itself():
    """What it changes of a surface reaches that through the kinds of particles and the volume of drops."""
    assert set(parameters_of(job(), "surface")["surface"]) == {
        *("smoothing_length_in_radii", "cube_size_in_radii", "threshold"),
        *("mesh_smoothing_iterations", "normals_smoothing_iterations"),
    }
    assert concerned(job(), job(surface={"drops_per_particle": 10})) == {"spray", "render"}  # larger drops are darker


def test_surfaces_and_volumes_are_counted_in_memory_too():
    smoke = {**TANK["smoke"][0], "cell_size": 0.002}
    need = first_of(job(smoke=[smoke]), "volume").resources.memory_bytes
    assert need > 500**3 * 66  # the domain of 1 m³, and what a cell was measured to take


def test_surfaces_claim_what_meshing_a_splash_was_measured_to_take():
    def claim(surface=(), **fluid):
        water = {**TANK["fluid"][0], "particle_radius": 0.0063, **fluid}
        return first_of(job(fluid=[water], surface=dict(surface)), "surface").resources.memory_bytes

    cube = {"shape": {"type": "sphere", "radius": 0.3}, "position": (0, 0, 0.5)}
    full = claim(block=[cube])  # no more is known of it than that half a million fill the domain of 1 m³
    assert 1146e6 < full < 1500e6  # the wildest frame of a dam break took 166 kB times n^(2/3) beside 100 MB
    assert claim({"cube_size_in_radii": 0.375}, block=[cube]) > 3 * full
    spout = {"shape": {"type": "disc", "radius": 0.02}, "position": (0, 0, 0.9), "direction": (0, 0, -1), "speed": 1.0}
    assert 100e6 < claim(block=[], emitter=[spout]) < 200e6  # it ends with the film


def test_volumes_depend_on_the_openvdb_that_writes_them(monkeypatch):
    before = digests(job())["volume"]
    monkeypatch.setattr("pipeline.kinds.smoke.tool_version", lambda package: "12.1" if package == "openvdb" else "5")
    installed = digests(job())["volume"]
    monkeypatch.setattr("pipeline.kinds.smoke.tool_version", lambda package: "12.1" if package == "openvdb" else "6")
    assert before != installed == digests(job())["volume"]


@pytest.mark.parametrize("package", ["taichi", "libigl", "numpy", "scipy", "trimesh"])
def test_frames_depend_on_every_package_that_computes_them(monkeypatch, package):
    before = digests(job())["simulate"]
    monkeypatch.setattr(
        "pipeline.stages.simulate.tool_version", lambda name: "0.0.1" if name == package else tool_version(name)
    )
    assert digests(job())["simulate"] != before


def test_a_blender_that_is_not_there_is_said_before_any_work(tmp_path):
    render = next(stage for stage in STAGES if stage.name == "render")
    (obstacle,) = render.preflight(job(render={"blender": str(tmp_path / "blender")}))
    assert "cannot start the Blender executable" in obstacle


def test_a_duck_comes_in_parts_with_colours_of_their_own():
    duck = {"name": "duck", "shape": {"type": "duck", "length": 0.2}}
    objects = render_spec(job(rigid=[duck]), LAYOUT).objects[:3]
    assert [each.name for each in objects] == ["duck", "duck.bill", "duck.eyes"]
    assert len({each.material.color for each in objects}) == 3
    assert [each.file for each in objects] == ["meshes/duck.ply", "meshes/duck.bill.ply", "meshes/duck.eyes.ply"]


@pytest.mark.parametrize("shape", ["duck", "bunny"])
def test_the_parts_that_have_looks_are_those_that_the_shape_has(shape):
    placement = Placement.model_validate({"shape": {"type": shape}})
    mesh = build_solid(placement).rest_mesh()
    assert parts_of(placement.shape) == mesh.part_names
    pieces = [mesh.piece(part) for part in mesh.part_names]
    assert sum(len(piece.faces) for piece in pieces) == len(mesh.faces)
    # The cut changes no triangle, so the volumes under the pieces' faces add up to float64 rounding.
    assert sum(piece.area_vectors.sum(axis=0) @ [1, 1, 1] for piece in pieces) == pytest.approx(0.0, abs=1e-9)
