"""What the stages plan for a job, and what they tell Blender."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.task import Resources
from pipeline.model.job import Job
from pipeline.model.looks import parts_of
from pipeline.queue.turns import GPU_TASKS
from pipeline.run.events import Start
from pipeline.run.plan import plan_job
from pipeline.run.scheduler import Scheduler
from pipeline.stages import STAGES
from pipeline.stages.movie import MovieStage
from pipeline.stages.render_scene import render_spec
from sim.shapes import build_solid
from sim.shapes.parameters import Placement

LAYOUT = JobLayout(Path("renders/tank"))

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


def digests(of: Job) -> dict[str, str]:
    return {task.stage: task.parameters.digest for task in plan_job(of, LAYOUT, STAGES)}


def test_every_frame_gets_its_surface_volume_and_picture():
    tasks = plan_job(job(), LAYOUT, STAGES)
    count = {stage.name: sum(task.stage == stage.name for task in tasks) for stage in STAGES}
    assert count == {
        "bodies": 1,
        "simulate": 1,
        "surface": 40,
        "cloth": 0,
        "volume": 40,
        "whitewater": 0,
        "bounds": 0,
        "render": 40,
        "movie": 3,
    }


def test_a_picture_waits_for_its_own_frame_only():
    tasks = {task.id: task for task in plan_job(job(), LAYOUT, STAGES)}
    assert tasks["render/000007"].inputs == (
        "meshes/ball.ply",
        "surfaces/water/000007.ply",
        "volumes/plume/000007.vdb",
    )


def test_the_film_is_cut_every_half_second():
    tasks = {task.id: task for task in plan_job(job(), LAYOUT, STAGES)}
    assert len(tasks["movie/segment-0000"].inputs) == 30
    assert len(tasks["movie/segment-0001"].inputs) == 10
    assert tasks["movie/film"].inputs == ("movie/0000.mp4", "movie/0001.mp4")


def test_a_job_with_masters_has_an_exr_beside_each_picture_of_its_film():
    tasks = {task.id: task for task in plan_job(job(render={"format": "exr"}), LAYOUT, STAGES)}
    assert tasks["render/000007"].outputs == ("frames/000007.png", "frames/000007.exr")
    assert tasks["movie/segment-0000"].inputs[7] == "frames/000007.png"


def test_frames_of_jobs_from_before_there_were_formats_stay_up_to_date():
    drawn = next(task for task in plan_job(job(), LAYOUT, STAGES) if task.stage == "render")
    assert not {"format", "passes", "order"} & set(json.loads(drawn.parameters.canonical)["render"])


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


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"passes": ["depth"]}, 'passes need format = "exr"'),
        ({"format": "exr", "passes": ["vector"]}, '"vector" needs motion_blur = false'),
        ({"format": "exr", "passes": ["depth", "depth"]}, "one of them twice"),
    ],
)
def test_passes_without_a_place_are_refused(table, sentence):
    with pytest.raises(ValidationError, match=sentence):
        job(render=table)


def test_a_film_for_editing_is_a_quicktime_film():
    tasks = {task.id: task for task in plan_job(job(movie={"codec": "prores"}), LAYOUT, STAGES)}
    assert tasks["movie/film"].inputs == ("movie/0000.mov", "movie/0001.mov")
    assert tasks["movie/film"].outputs == ("movie.mov",)


def test_the_film_of_a_folder_is_the_one_that_its_job_asks_for(tmp_path):
    layout = JobLayout(tmp_path)
    assert layout.film == tmp_path / "movie.mp4"
    for name in ("movie.mp4", "movie.mov"):  # the last one made is not what counts
        (tmp_path / name).touch()
    layout.job_file.write_text('name = "tank"\n[movie]\ncodec = "prores"\n')
    assert layout.film == tmp_path / "movie.mov"
    layout.job_file.write_text('name = "tank"\n')
    assert layout.film == tmp_path / "movie.mp4"


def test_films_of_jobs_from_before_there_were_other_codecs_stay_up_to_date():
    (film,) = (task for task in plan_job(job(), LAYOUT, STAGES) if task.id == "movie/film")
    parameters = json.loads(film.parameters.canonical)
    assert parameters["movie"] == {"crf": 16, "preset": "medium", "playback_fps": None}


def test_an_encoder_that_is_not_there_is_told_before_any_work(monkeypatch):
    monkeypatch.setattr("render.movie.missing_encoder", lambda _codec: "libx265")
    (told,) = MovieStage().preflight(job(movie={"codec": "h265"}))
    assert told.startswith('"h265" needs the encoder libx265')


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"codec": "prores", "crf": 10}, "crf has no meaning for prores"),
        ({"codec": "prores", "preset": "slow"}, "preset has no meaning for prores"),
        ({"codec": "h265", "crf": 52}, "crf of h265 is at most 51, got 52"),
    ],
)
def test_keys_that_a_codec_has_not_are_refused(table, sentence):
    with pytest.raises(ValidationError, match=sentence):
        job(movie=table)


@pytest.mark.parametrize(
    ("change", "concerned"),
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
        ({"fps": 30}, {"simulate", "volume", "render", "movie"}),
        ({"set": {"color": [0.22, 0.25, 0.29], "background": "set", "rotation_deg": 0.0}}, set()),
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
def test_a_change_concerns_only_the_stages_that_read_it(change, concerned):
    before, after = digests(job()), digests(job(**change))
    assert {stage for stage in before if before[stage] != after[stage]} == concerned


def test_frames_of_a_job_without_later_keys_of_stages_stay_up_to_date():
    """What earlier versions wrote into the parameters of a frame."""
    task = next(task for task in plan_job(job(), LAYOUT, STAGES) if task.stage == "render")
    document = json.loads(task.parameters.canonical)
    assert document["stage"] == {"name": "studio", "strength": 1.0, "color": [0.22, 0.25, 0.29], "tank": False}
    assert set(document["objects"][0]["material"]) == {
        *("look", "color", "roughness", "density", "thread_spacing"),
        *("anisotropy", "edge_fade", "emission", "flame_temperature"),
    }


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
        task = next(task for task in plan_job(tank, LAYOUT, STAGES) if task.stage == "render")
        objects = {each["name"]: each for each in json.loads(task.parameters.canonical)["objects"]}
        # Frames of earlier versions stay up to date where nothing wets anything.
        assert {name for name, each in objects.items() if "wets_within" in each} == ({"water"} if reach else set())


@pytest.mark.parametrize("look", ["honey", "cotton", "silk", "denim"])
def test_frames_with_a_look_that_has_changed_are_drawn_again_and_others_are_not(look):
    tank = job(material={"ball": {"look": look}})
    task = next(task for task in plan_job(tank, LAYOUT, STAGES) if task.stage == "render")
    objects = {each["name"]: each for each in json.loads(task.parameters.canonical)["objects"]}
    assert {name for name, each in objects.items() if "look_revision" in each["material"]} == {"ball"}


@pytest.mark.parametrize("is_seen", [True, False])
def test_frames_with_a_tank_are_drawn_again_and_others_are_not(is_seen):
    task = next(task for task in plan_job(job(set={"tank": is_seen}), LAYOUT, STAGES) if task.stage == "render")
    assert ("tank_revision" in json.loads(task.parameters.canonical)["stage"]) == is_seen


def test_frames_with_a_material_of_a_blend_file_on_cloth_are_drawn_again_and_others_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.stages.render.own_picture_bytes", lambda _: 0)
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    shape = {"type": "rectangle", "size": [0.2, 0.2], "counts": [5, 5]}
    cloth = [
        {"name": name, "material": "cotton", "shape": shape, "position": [0.0, y, 0.8]}
        for name, y in (("flag", 0.0), ("sail", 0.5))
    ]
    material = {name: {"blend": f"{tmp_path}/own.blend:Linen"} for name in ("ball", "water", "flag")}
    tank = job(cloth=cloth, material=material)
    task = next(task for task in plan_job(tank, LAYOUT, STAGES) if task.stage == "render")
    objects = {each["name"]: each["material"] for each in json.loads(task.parameters.canonical)["objects"]}
    assert {name for name, each in objects.items() if "blend" in each} == {"ball", "water", "flag"}
    assert {name for name, each in objects.items() if "blend_revision" in each} == {"flag"}


def rendered_parameters(of: Job) -> dict[str, Any]:
    task = next(task for task in plan_job(of, LAYOUT, STAGES) if task.stage == "render")
    parameters: dict[str, Any] = json.loads(task.parameters.canonical)
    return parameters


@pytest.mark.parametrize(
    ("faces", "is_seen", "kept"),
    [
        (["z+"], True, None),
        (["z+", "z-"], True, None),
        (["x+", "z+"], False, None),
        (["y-", "x+", "z+"], True, ["x+", "y-"]),
    ],
)
def test_open_faces_count_for_pictures_only_where_a_pane_is_left_out(faces, is_seen, kept):
    tank = job(domain={"open_faces": faces}, set={"tank": is_seen})
    assert render_spec(tank, LAYOUT).open_faces == tuple(faces)
    assert rendered_parameters(tank).get("open_faces") == kept


def test_lights_have_the_power_that_is_usual_for_their_type_and_only_suns_are_drawn_again():
    place = {"position": [1, 0, 1]}
    lights = rendered_parameters(job(light=[place, place | {"type": "point"}, place | {"type": "sun"}]))["lights"]
    assert [light["power"] for light in lights] == [100.0, 100.0, 5.0]
    assert ["sun_revision" in light for light in lights] == [False, False, True]


@pytest.mark.parametrize("angles", [(0, 0, 0), (90, 0, 0), (10, 20, 30), (-35, 120, 200)])
def test_blender_turns_a_body_as_the_simulation_does(angles):
    spec = render_spec(job(rigid=[{**TANK["rigid"][0], "rotation_deg": angles}]), LAYOUT)
    w, x, y, z = spec.objects[0].orientation
    ours = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(ours, Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), atol=1e-12)


def test_nothing_stands_in_the_way_of_a_job_on_this_machine_but_what_is_said(monkeypatch):
    simulate = next(stage for stage in STAGES if stage.name == "simulate")
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "no driver"})
    assert simulate.preflight(job()) == []
    (obstacle,) = simulate.preflight(job(device="cuda"))
    assert obstacle == 'device "cuda" is not available: no driver; use device = "auto" or "cpu"'


@pytest.mark.parametrize("device", ["cuda", "vulkan", "metal"])
def test_a_device_that_does_not_work_here_is_planned_all_the_same(monkeypatch, device):
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok"})
    (simulate,) = (task for task in plan_job(job(device=device), LAYOUT, STAGES) if task.stage == "simulate")
    assert (simulate.resources.cores, simulate.resources.gpus) == (1, 1)


def test_a_device_left_open_takes_the_resources_of_the_one_that_works(monkeypatch):
    def resources(devices: dict[str, str]) -> Resources:
        monkeypatch.setattr("sim.core.runtime.available_devices", lambda: devices)
        return next(task.resources for task in plan_job(job(device="auto"), LAYOUT, STAGES) if task.id == "simulate")

    assert resources({"cpu": "ok"}) == Resources(cores=0)
    with_gpu = resources({"cpu": "ok", "cuda": "ok"})
    assert (with_gpu.cores, with_gpu.gpus) == (1, 1)


def test_frames_on_their_way_to_the_disk_are_counted_in_memory():
    def need(radius: float) -> int:
        ball = {"shape": {"type": "sphere", "radius": 0.1}}
        fluid = {"name": "water", "block": [ball], "particle_radius": radius}
        tasks = plan_job(job(device="cuda", fluid=[fluid]), LAYOUT, STAGES)
        return next(task.resources.memory_bytes for task in tasks if task.stage == "simulate")

    particles = 1.0 / 0.01**3  # all that fit into the domain of 1 m³, as a ball's volume is not looked at
    assert need(0.005) - need(0.05) > 3 * 32 * 0.99 * particles  # three frames of 32 bytes a particle


@pytest.mark.parametrize(
    "domain", [{"min": (-5, -5, 0), "max": (5, 5, 5)}, {"min": (-0.1, -0.1, 0), "max": (0.1, 0.1, 0.2)}]
)
def test_smoke_is_counted_in_memory_by_its_own_box(domain):
    fog = {"name": "fog", "cell_size": 0.01, "min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0),
           "source": [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.2)}]}  # fmt: skip

    def need(smoke: list[dict]) -> int:
        tasks = plan_job(job(device="cuda", fluid=[], domain=domain, smoke=smoke), LAYOUT, STAGES)
        return next(task.resources.memory_bytes for task in tasks if task.stage == "simulate")

    # Of 100³ cells: five frames of five arrays, and less than ten of six.
    assert 5 * 5 * 4 * 100**3 < need([fog]) - need([]) < 10 * 6 * 4 * 100**3


def test_a_job_simulated_on_a_gpu_elsewhere_is_rendered_on_a_machine_without_one():
    tasks = plan_job(job(device="cuda"), LAYOUT, STAGES)
    done = {task.id for task in tasks if task.stage != "render"}
    scheduler = Scheduler(tasks, up_to_date=done, capacity=Resources(cores=2, gpus=GPU_TASKS))
    assert [each.task.stage for each in scheduler.start() if isinstance(each, Start)] == ["render"]


def test_pictures_drawn_on_the_gpu_take_turns():
    def gpus(device: str) -> set[int]:
        tasks = plan_job(job(render={"device": device}), LAYOUT, STAGES)
        return {task.resources.gpus for task in tasks if task.stage == "render"}

    assert (gpus("gpu"), gpus("cpu")) == ({1}, {0})


@pytest.mark.parametrize("resolution", [(480, 270), (1920, 1080), (3840, 2160)])
def test_many_cores_do_not_draw_more_than_the_memory_holds(resolution):
    """64 cores beside 8 GB: by cores alone, 32 frames would be drawn at once."""
    tasks = plan_job(job(render={"resolution": resolution}), LAYOUT, STAGES)
    capacity = Resources(cores=64, memory_bytes=8_000_000_000)
    ready = {task.id for task in tasks if task.stage in ("bodies", "simulate", "surface", "volume")}
    scheduler = Scheduler(tasks, up_to_date=ready, capacity=capacity)
    started = [each for each in scheduler.start() if isinstance(each, Start)]
    worker = 450e6 + 690 * resolution[0] * resolution[1]  # as measured: 538 MB at 480 x 270, 1880 MB at 1920 x 1080
    assert 1 <= len(started) < 32
    assert len(started) * worker <= capacity.memory_bytes
    assert scheduler.free.memory_bytes < started[0].task.resources.memory_bytes  # and no fewer than it holds


def test_surfaces_with_droplets_as_they_are_are_those_of_earlier_versions():
    def document(**keys) -> dict:
        task = next(task for task in plan_job(job(surface=keys), LAYOUT, STAGES) if task.stage == "surface")
        return json.loads(task.parameters.canonical)

    former = document(droplet_size=1.0)
    assert set(former["surface"]) == {
        *("smoothing_length_in_radii", "cube_size_in_radii", "threshold"),
        *("mesh_smoothing_iterations", "normals_smoothing_iterations"),
    }
    assert set(former["tools"]) == {"pysplashsurf"}
    assert document(droplet_size=0.5) == document() != former


def test_surfaces_and_volumes_are_counted_in_memory_too():
    smoke = {**TANK["smoke"][0], "cell_size": 0.002}
    tasks = plan_job(job(smoke=[smoke]), LAYOUT, STAGES)
    need = {task.stage: task.resources.memory_bytes for task in tasks}
    assert need["volume"] > 500**3 * 66  # the domain of 1 m³, and what a cell was measured to take


def test_surfaces_claim_what_meshing_a_splash_was_measured_to_take():
    def claim(surface=(), **fluid):
        water = {**TANK["fluid"][0], "particle_radius": 0.0063, **fluid}
        tasks = plan_job(job(fluid=[water], surface=dict(surface)), LAYOUT, STAGES)
        return next(task.resources.memory_bytes for task in tasks if task.stage == "surface")

    cube = {"shape": {"type": "sphere", "radius": 0.3}, "position": (0, 0, 0.5)}
    full = claim(block=[cube])  # no more is known of it than that half a million fill the domain of 1 m³
    assert 798e6 < full < 1200e6
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


DUCK = {"name": "duck", "shape": {"type": "duck", "length": 0.2}}


def test_a_duck_comes_in_parts_with_colours_of_their_own():
    objects = render_spec(job(rigid=[DUCK]), LAYOUT).objects
    assert [each.name for each in objects[:3]] == ["duck", "duck.bill", "duck.eyes"]
    assert len({each.material.color for each in objects[:3]}) == 3
    assert [each.file for each in objects[:3]] == ["meshes/duck.ply", "meshes/duck.bill.ply", "meshes/duck.eyes.ply"]


def test_a_duck_of_metal_is_of_one_piece():
    objects = render_spec(job(rigid=[DUCK], material={"duck": {"look": "metal"}}), LAYOUT).objects
    assert {each.material.look for each in objects[:3]} == {"metal"}


def test_a_part_can_be_painted():
    material = {"duck.bill": {"look": "rubber", "color": (0.0, 0.2, 0.9)}}
    objects = render_spec(job(rigid=[DUCK], material=material), LAYOUT).objects
    assert objects[1].material.color == (0.0, 0.2, 0.9)


@pytest.mark.parametrize("shape", ["duck", "bunny"])
def test_the_parts_that_have_looks_are_those_that_the_shape_has(shape):
    mesh = build_solid(Placement.model_validate({"shape": {"type": shape}})).rest_mesh()
    assert parts_of(shape) == mesh.part_names
    pieces = [mesh.piece(part) for part in mesh.part_names]
    assert sum(len(piece.faces) for piece in pieces) == len(mesh.faces)
    # The cut changes no triangle, so the volumes under the pieces' faces add up to float64 rounding.
    assert sum(piece.area_vectors.sum(axis=0) @ [1, 1, 1] for piece in pieces) == pytest.approx(0.0, abs=1e-9)
