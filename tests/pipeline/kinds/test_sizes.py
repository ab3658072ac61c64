"""Sizes of bodies by the job alone, and what follows from them: the density of looks, and what a camera shows."""

import json
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planned_jobs import digests

from pipeline.base.errors import MissingInputError
from pipeline.base.layout import JobLayout
from pipeline.kinds.sizes import box_of, measures_of, size_of_liquid, size_of_smoke
from pipeline.kinds.table import drawn_bodies, scene_boxes
from pipeline.model.job import Job
from pipeline.stages.render_scene import render_spec
from render.meshes import write_ply
from render.visibility import screen_positions
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

LAYOUT = JobLayout(Path("film"))
BLOCK = {"shape": {"type": "box", "size": [0.2, 0.4, 0.8]}, "position": [0.0, 0.0, 0.5]}
WATER = {"name": "water", "block": [BLOCK]}
SOURCE = {"shape": {"type": "sphere", "radius": 0.05}, "position": [0.0, 0.0, 0.1]}
PLUME = {"name": "plume", "source": [SOURCE]}
WOOD = {"material": {"look": "wood"}}


def job(**tables: Any) -> Job:
    return Job.model_validate({"name": "film", "frames": 60, **tables})


def domain(factor: float) -> dict[str, Any]:
    return {"min": [-factor, -factor, 0.0], "max": [factor, factor, 2.0 * factor]}


def densities(scene: Job) -> dict[str, float | None]:
    """Of all bodies; drops have the colour of their size, and no density."""
    drawn = [each for _, _, each in drawn_bodies(scene, LAYOUT)]
    assert all(each.material.density is None for each in drawn if each.name.endswith(".drops"))
    return {each.name: each.material.density for each in drawn if not each.name.endswith(".drops")}


@pytest.mark.parametrize("shape", [{"type": "duck", "length": 0.4}, {"type": "bunny", "height": 0.4}])
def test_measures_of_modelled_shapes_are_those_of_their_solids(shape):
    placement = Placement.model_validate({"shape": shape, "scale": 1.5})
    solid = build_solid(placement)
    measures = measures_of(placement)
    assert measures.volume == pytest.approx(solid.volume, rel=1e-4)
    assert measures.edges == pytest.approx(solid.bounds[1] - solid.bounds[0], rel=1e-4)


def test_the_box_of_a_turned_body_holds_it_and_is_its_own_where_it_is_straight():
    turned = Placement.model_validate(
        {"shape": {"type": "duck", "length": 0.4}, "position": [1.0, 2.0, 3.0], "rotation_deg": [20.0, 30.0, 40.0]}
    )
    box, exact = box_of(turned), build_solid(turned).bounds
    assert (box[0] <= exact[0]).all()
    assert (box[1] >= exact[1]).all()
    straight = turned.model_copy(update={"rotation_deg": (0.0, 0.0, 0.0)})
    np.testing.assert_allclose(box_of(straight), build_solid(straight).bounds, rtol=1e-4)


def test_a_liquid_is_as_large_as_all_of_it_that_will_be():
    falls = {"shape": {"type": "rectangle", "size": [0.1, 0.2]}, "position": [0, 0, 1], "direction": [0, 0, -1]}
    emitter = {**falls, "speed": 0.5, "start_s": 0.2}
    sizes = [
        size_of_liquid(job(fluid=[fluid], domain=domain(1.0)), job(fluid=[fluid]).fluid[0])
        for fluid in (
            WATER,
            {"name": "jet", "emitter": [emitter]},
            {**WATER, "emitter": [{**emitter, "end_s": 0.6}]},
            {**WATER, "particle_radius": 0.01, "max_particles": 1000},
            {"name": "sea", "block": [{**BLOCK, "scale": 100.0}]},
        )
    ]
    # In a film of a second the jet flows for 0.8 s; what does not fit into the domain is not there.
    expected = [0.064, 0.1 * 0.2 * 0.5 * 0.8, 0.064 + 0.1 * 0.2 * 0.5 * 0.4, 1000 * 0.02**3, 2.0 * 2.0 * 2.0]
    assert sizes == pytest.approx([volume ** (1 / 3) for volume in expected])


def test_smoke_is_as_large_as_its_strongest_source():
    wide_and_thin = {**SOURCE, "shape": {"type": "sphere", "radius": 0.2}, "density": 0.1}
    later = {**SOURCE, "shape": {"type": "sphere", "radius": 3.0}, "start_s": 5.0}
    heat = {**SOURCE, "shape": {"type": "sphere", "radius": 1.0}, "density": 0.0}
    one = job(smoke=[{"name": "plume", "source": [{**SOURCE, "density": 1.0}]}])
    scene = job(smoke=[{"name": "plume", "source": [wide_and_thin, SOURCE, later, heat]}])
    assert size_of_smoke(scene, scene.smoke[0]) == pytest.approx(0.1)
    faint = job(smoke=[{"name": "plume", "source": [{**SOURCE, "ramp": [{"time_s": 0.0, "strength": 0.5}]}]}])
    assert size_of_smoke(faint, faint.smoke[0]) == pytest.approx(0.05)
    burning = {**SOURCE, "temperature": 700.0, "density": 0.0, "fuel": 0.5}
    fire = job(smoke=[{"name": "plume", "source": [burning], "fire": {"soot": 0.8}}])
    assert size_of_smoke(fire, fire.smoke[0]) == pytest.approx(0.4 * size_of_smoke(one, one.smoke[0]))
    nothing = job(smoke=[{"name": "plume", "source": [heat]}])
    assert size_of_smoke(nothing, nothing.smoke[0]) == pytest.approx(2.0)


def test_a_larger_domain_changes_no_look():
    tables = {
        "fluid": [WATER],
        "smoke": [{**PLUME, "min": [-0.5, -0.5, 0.0], "max": [0.5, 0.5, 1.0]}],
        "rigid": [{"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "position": [0.3, 0.3, 0.2]}],
        "cloth": [{"name": "sheet", "shape": {"type": "rectangle", "size": [0.4, 0.3], "counts": [5, 4]}}],
        "material": {"sheet": {"look": "wood"}, "ball": {"look": "milk"}},
    }
    small, large = (render_spec(job(domain=domain(factor), **tables), LAYOUT) for factor in (1.0, 2.0))
    assert small.objects == large.objects
    assert small.domain_max != large.domain_max


def test_each_body_has_a_density_of_its_own_size():
    half = {**BLOCK, "scale": 0.5, "position": [0.5, 0.0, 0.5]}
    scene = job(
        fluid=[WATER, {"name": "wine", "block": [half]}, {"name": "clear", "block": [half]}],
        smoke=[PLUME],
        material={"wine": {"color": [0.5, 0.02, 0.03]}, "clear": {"density": 0.25}},
    )
    # A tint is seen across the body; the blue of water is that of 2.2 m; a source of 0.1 m has a depth of 2.5.
    assert densities(scene) == {
        "water": pytest.approx(2.2 / 0.4, rel=1e-5),
        "wine": pytest.approx(10.0 / 0.2, rel=1e-5),
        "clear": 0.25,
        "plume": pytest.approx(25.0, rel=1e-5),
    }


def test_a_density_is_written_with_no_more_digits_than_every_machine_agrees_on():
    (density,) = densities(job(fluid=[{"name": "water", "block": [{**BLOCK, "scale": 1.0 / 3.0}]}])).values()
    assert len(json.dumps(density).replace(".", "")) <= 6


def test_bodies_of_a_mesh_are_measured_by_the_file(tmp_path):
    ball = build_solid(Placement.model_validate({"shape": {"type": "sphere", "radius": 0.1}})).surface_mesh(0.02)
    write_ply(tmp_path / "ball.ply", ball.vertices, ball.faces)
    shape = {"type": "mesh", "file": str(tmp_path / "ball.ply")}
    scene = job(rigid=[{"name": "drop", "shape": shape}], material={"drop": {"look": "water"}})
    assert densities(scene)["drop"] == pytest.approx(2.2 / (4 / 3 * pi * 0.1**3) ** (1 / 3), rel=0.01)
    (tmp_path / "ball.ply").unlink()
    with pytest.raises(MissingInputError, match=r"cannot read the mesh .*ball\.ply"):
        densities(scene)


def test_the_density_of_a_look_decides_frames_and_nothing_else():
    """A density, whether the job gives it or the size of the body, is of the pictures alone."""
    scene = {"fluid": [WATER], "smoke": [PLUME], "domain": domain(1.0), "device": "cpu"}
    explicit = {"water": {"density": 3.0}, "plume": {"density": 9.0}}
    before, after = (digests(job(**scene, material=material)) for material in (explicit, {}))
    assert {stage for stage in before if before[stage] != after[stage]} == {"render"}


def test_a_camera_without_a_place_shows_domain_smoke_and_bodies_beside_it():
    beyond = {
        "domain": domain(0.5),
        "rigid": [
            {"name": "mast", "shape": {"type": "cylinder", "radius": 0.02, "height": 1.6}, "position": [0.5, 0.0, 0.8]},
            {"name": "slab", "shape": {"type": "box", "size": [9.0, 9.0, 0.1]}, "position": [0.0, 0.0, -0.04]},
            {
                "name": "cart",
                "kind": "kinematic",
                "shape": {"type": "box", "size": [0.1, 0.1, 0.1]},
                "keyframe": [
                    {"time_s": 0.0, "position": [0.0, 0.0, 0.1]},
                    {"time_s": 1.0, "position": [0.9, 0.0, 0.1]},
                ],
            },
        ],
        "smoke": [{**PLUME, "min": [-1.2, -0.2, 0.0], "max": [-0.4, 0.2, 1.0]}],
    }
    boxes = scene_boxes(job(**beyond))
    # The slab is ground.
    np.testing.assert_allclose(
        [boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)], [[-1.2, -0.5, 0.0], [0.95, 0.5, 1.6]]
    )
    view = render_spec(job(**beyond), LAYOUT).camera
    corners = np.array([[x, y, z] for box in boxes for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    screen = screen_positions(view, corners, aspect=16 / 9)
    assert (abs(screen) <= 0.9 + 1e-9).all()
