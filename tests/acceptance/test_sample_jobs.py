"""Every job in jobs/ runs, small and short."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import av
import pytest
from command_line import pipeline
from places import PROJECT

JOBS = sorted((PROJECT / "jobs").glob("*.toml"))

TINY = {
    "ball_into_cloth": {"cloth.sheet.shape.counts": [9, 9]},
    "breaking_vase": {"rigid.vase.breaks.pieces": 4},
    "brick_wall_in_flood": {"fluid.water.particle_radius": 0.025, "rigid.brick.count": [1, 5, 2]},
    "campfire": {"smoke.fire.cell_size": 0.04},
    "cloth_over_bunny": {"cloth.veil.shape.counts": [11, 11]},
    "cloth_over_sphere": {"cloth.sheet.shape.counts": [11, 11]},
    "dam_break": {"fluid.water.particle_radius": 0.025},
    "dominoes": {"rigid.domino.count": 12},
    "drop_on_bunny_dfsph": {"fluid.water.particle_radius": 0.05},
    "drop_on_bunny_wcsph": {"fluid.water.particle_radius": 0.05, "fluid.water.dt": 1.0e-3},
    "duck_in_pool_pcisph": {"fluid.water.particle_radius": 0.05},
    "everything": {
        "cloth.cloth.shape.counts": [11, 11],
        "fluid.water.particle_radius": 0.025,
        "smoke.fog.cell_size": 0.04,
    },
    "fireball": {"smoke.fire.cell_size": 0.17},
    "flag_in_wind": {"cloth.flag.shape.counts": [13, 9]},
    "floating_bodies": {"fluid.water.particle_radius": 0.025},
    "hammock_of_water": {"cloth.sheet.shape.counts": [13, 13], "fluid.water.emitter.0.start_s": 0.0},
    "honey": {"fluid.honey.particle_radius": 0.0008},
    "hourglass": {"soft.sand.cell_size": 0.01, "soft.sand.young_modulus": 2.0e4},
    "jelly_and_ball": {"soft.jelly.cell_size": 0.03},
    "leaves_in_wind": {"rigid.maple.count": 4, "rigid.birch.count": 4, "rigid.oak.count": 4},
    "quickstart": {"fluid.water.particle_radius": 0.02, "smoke.plume.cell_size": 0.06},
    "sand_castle": {"soft.castle.cell_size": 0.03, "fluid.sea.particle_radius": 0.02},
    "smoke_in_box": {"smoke.plume.cell_size": 0.016},
    "smoke_moving_duck": {"smoke.fog.cell_size": 0.06},
    "smoke_past_sphere": {"smoke.smoke.cell_size": 0.02},
    "snowball": {"soft.snow.cell_size": 0.03},
    "train": {"smoke.smoke.cell_size": 0.26},
    "water_mill": {"fluid.water.particle_radius": 0.0075},
    "wine_glass": {"fluid.wine.particle_radius": 0.002},
}


def test_every_sample_job_has_a_tiny_version():
    assert [path.stem for path in JOBS] == sorted(TINY)


def submit(*arguments: object) -> tuple[int, str]:
    ended = pipeline("submit", *arguments)
    return ended.exit_code, ended.output


@pytest.fixture(scope="module")
def child() -> Iterator[ProcessPoolExecutor]:
    """One process for all jobs, which compiles kernels and imports Blender once."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        yield executor


@pytest.mark.slow
@pytest.mark.parametrize("path", JOBS, ids=lambda path: path.stem)
def test_a_sample_job_becomes_a_film(child, path, tmp_path):
    changes = {"frames": 2, "render.resolution": [64, 36], "render.samples": 1, "device": "cpu", **TINY[path.stem]}
    options = [part for key, value in changes.items() for part in ("--set", f"{key}={value}")]
    making = child.submit(submit, path, "--farm", tmp_path, "--executor", "inline", *options)
    code, told = making.result(timeout=1200)  # compiling may take minutes
    assert code == 0, told
    with av.open(str(tmp_path / path.stem / "movie.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 2
