"""How much a job will write, and the reserve that stays free."""

from collections import namedtuple

import click
import pytest

from blender_scripts.ply import POINT
from pipeline.cli.arguments import parse_age, parse_size
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from pipeline.queue import disk

SIZE = disk.Size(elements={"fluid": 1_000_000}, pixels=1920 * 1080)
Usage = namedtuple("Usage", "total used free")


def test_files_take_what_their_elements_and_pixels_take():
    # 26 bytes a particle and 1.2 a pixel; two checkpoints are there once.
    assert disk.bytes_per_artifact("simulate", SIZE) == pytest.approx(22_000 + 26e6)
    assert disk.bytes_per_artifact("render", SIZE) == pytest.approx(1_000 + 1.2 * 1920 * 1080)
    assert disk.checkpoint_bytes(SIZE) == pytest.approx(2 * 90e6)


def test_drops_count_with_what_the_spray_breaks_up_into():
    assert POINT.itemsize == 33
    two_files = 2.0 * disk.bytes_per_artifact("spray", SIZE._replace(drops_per_particle=40.0))
    # 3 % of the particles are spray, of which each is 40 drops; films of three splashes had 13 to 27 bytes a particle.
    assert two_files == pytest.approx(1e6 * (1.0 + 0.03 * 40 * 33))
    assert disk.bytes_per_artifact("spray", SIZE) == pytest.approx(0.5e6)


@pytest.mark.parametrize("kind", ["cloth", "fluid"])
def test_a_file_of_one_of_ten_bodies_takes_what_one_body_takes(kind):
    sheet = {"material": "cotton", "shape": {"type": "rectangle", "size": [0.1, 0.1], "counts": [10, 10]}}
    block = {"shape": {"type": "box", "size": [0.1, 0.1, 0.1]}, "position": [0.0, 0.0, 0.2]}
    table = sheet if kind == "cloth" else {"particle_radius": 0.01, "block": [block]}
    stages = ["cloth"] if kind == "cloth" else ["surface", "spray", "whitewater"]

    def bytes_of(count: int) -> list[float]:
        bodies = [{"name": f"body_{number}", **table} for number in range(count)]
        job = Job.model_validate({"name": "film", "frames": 1, kind: bodies}, strict=False)
        size = disk.size_of(job, Findings(elements={kind: 100 * count}))
        return [disk.bytes_per_artifact(stage, size) for stage in stages]

    assert bytes_of(1)[0] == pytest.approx(70.0 * 100 if kind == "cloth" else 4_500.0 * 100 ** (2 / 3))
    assert bytes_of(10) == pytest.approx(bytes_of(1))


@pytest.mark.parametrize(
    ("radius", "surface", "drops"),
    [
        (0.02, {}, 16),
        (0.02, {"drops_per_particle": 7}, 7),
        (0.02, {"drops_per_particle": 0}, 0),
        # A cube of 2 mm is 0.8 balls of 2.7 mm, and drops are 1.9 times that in the mean; thin ligaments make more.
        (0.001, {}, 4),
    ],
)
def test_a_particle_breaks_up_into_no_more_drops_than_it_has_volume_for(radius, surface, drops):
    block = {"shape": {"type": "box", "size": [0.1, 0.1, 0.1]}, "position": [0.0, 0.0, 0.2]}
    fluid = [{"name": "water", "particle_radius": radius, "block": [block]}]
    job = Job.model_validate({"name": "tank", "frames": 1, "fluid": fluid, "surface": surface}, strict=False)
    assert 0.55 * drops <= disk.size_of(job, Findings()).drops_per_particle <= drops


@pytest.mark.parametrize(
    ("render", "bytes_per_pixel"),
    [
        ({}, 1.2),
        ({"format": "png16"}, 4.7),
        ({"format": "exr"}, (1.2 + 1.0) / 2),
        ({"format": "exr", "passes": ["depth", "normal"]}, (1.2 + 17.0) / 2),
    ],
)
def test_masters_and_deep_pictures_count_with_what_they_take(render, bytes_per_pixel):
    scene = {"name": "still", "frames": 1, "rigid": [{"name": "b", "shape": {"type": "sphere", "radius": 0.1}}]}
    job = Job.model_validate({**scene, "render": render, "movie": {"codec": "prores"}}, strict=False)
    size = disk.size_of(job, Findings())
    assert size.picture_bytes_per_pixel == pytest.approx(bytes_per_pixel)
    assert size.film_factor == 30.0


def test_the_reserve_is_a_share_of_a_small_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(10 * 2**30, 0, 2**30))
    assert disk.usual_reserve_bytes(tmp_path) == 2**29
    assert disk.shortage(tmp_path, None) is None
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(10 * 2**30, 0, 2**28))
    assert disk.shortage(tmp_path, None) == ("only 256.0 MiB are free on the disk, less than the reserve of 512.0 MiB")
    assert disk.shortage(tmp_path, 0) is None
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(10 * 2**40, 0, 2**30))
    assert disk.usual_reserve_bytes(tmp_path) == 2 * 2**30


CONTEXT = click.Context(click.Command("x"))
OPTION = click.Option(["--x"])


@pytest.mark.parametrize(
    ("text", "size"),
    [("0", 0), ("500", 500), ("500MB", 500_000_000), ("2GiB", 2 * 2**30), ("1.5 k", 1500), ("1TB", 10**12)],
)
def test_sizes_are_read(text, size):
    assert parse_size(CONTEXT, OPTION, text) == size


@pytest.mark.parametrize("text", ["", "GB", "-1", "1e9", "two", "1PB"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(click.BadParameter, match="is not a size"):
        parse_size(CONTEXT, OPTION, text)


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("30m", 1800), ("12h", 43200), ("7d", 604800), ("2w", 1209600)]
)
def test_ages_are_read(text, seconds):
    assert parse_age(CONTEXT, OPTION, text) == seconds
