"""What `check` says of a job's set and of the picture around the scene."""

from pathlib import Path

import numpy as np
import pytest
from checked_jobs import checked, says
from PIL import Image
from radiance_pictures import write_hdr

from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.input_files import split_blend
from pipeline.job.inputs import keep_inputs
from pipeline.job.loading import load_job, read_job

BALL = """
name = "film"
frames = 1
[[rigid]]
name = "ball"
kind = "kinematic"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
[set]
"""


def problems(folder: Path, keys: str) -> tuple[list[str], list[str]]:
    """Errors and warnings of a ball on a set."""
    result = checked(BALL + keys, folder / "film.toml")
    return result.errors, result.warnings


def test_the_former_name_of_the_table_is_told_in_one_line(tmp_path):
    (tmp_path / "film.toml").write_text(BALL.replace("[set]", '[stage]\nname = "night"'))
    with pytest.raises(JobFileError) as caught:
        load_job(tmp_path / "film.toml")
    assert str(caught.value) == "film.toml:9 stage: [stage] is now [set]"


def test_a_picture_around_the_scene_passes_and_is_found_beside_the_job(tmp_path):
    write_hdr(tmp_path / "noon.hdr", np.ones((8, 16, 3)))
    assert problems(tmp_path, 'hdri = "noon.hdr"\nrotation_deg = 30') == ([], [])
    assert read_job(tmp_path / "film.toml").job.set.hdri == str(tmp_path / "noon.hdr")


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("non.hdr", 'no such file: {folder}/non.hdr; did you mean "noon.hdr"?'),
        ("folder.hdr", "{folder}/folder.hdr is a folder, not a picture"),
        ("text.hdr", "{folder}/text.hdr: cannot be decoded"),
        ("short.hdr", "{folder}/short.hdr: cannot be decoded"),
        ("film.toml", "{folder}/film.toml: is no .hdr or .exr picture"),
    ],
)
def test_a_picture_that_cannot_be_read_is_refused_before_any_work(tmp_path, written, expected):
    whole = write_hdr(tmp_path / "noon.hdr", np.random.default_rng(1).random((32, 64, 3)))
    (tmp_path / "text.hdr").write_text("this is no picture")
    (tmp_path / "short.hdr").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "folder.hdr").mkdir()
    (error,), _ = problems(tmp_path, f'hdri = "{written}"')
    assert error.startswith(f"film.toml:10 set.hdri: {expected.format(folder=tmp_path)}")


@pytest.mark.parametrize("name", ["photo.jpg", "photo.png"])
def test_a_backplate_passes_and_is_kept_with_the_job(tmp_path, name):
    Image.new("RGB", (320, 180), (200, 80, 20)).save(tmp_path / name)
    assert problems(tmp_path, f'backplate = "{name}"') == ([], [])
    loaded, content = read_job(tmp_path / "film.toml"), (tmp_path / name).read_bytes()
    assert loaded.job.set.backplate == str(tmp_path / name)
    layout = JobLayout(tmp_path / "renders" / "film")
    _, text = keep_inputs(loaded, layout)
    layout.job_file.write_text(text)
    (tmp_path / name).unlink()
    assert Path(load_job(layout.job_file).set.backplate or "").read_bytes() == content


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("phot.jpg", 'no such file: {folder}/phot.jpg; did you mean "photo.jpg"?'),
        ("text.jpg", "{folder}/text.jpg: is no JPEG or PNG picture"),
        ("photo.webp", "{folder}/photo.webp: is no JPEG or PNG picture"),
        ("short.jpg", "{folder}/short.jpg: cannot be decoded"),
        ("print.jpg", "{folder}/print.jpg: has CMYK colours; save it as RGB"),
        ("turned.jpg", "{folder}/turned.jpg: is stored turned (EXIF orientation 6); save it upright"),
    ],
)
def test_a_backplate_that_cannot_be_read_as_it_is_meant_is_refused(tmp_path, written, expected):
    pixels = np.random.default_rng(2).integers(0, 255, (180, 320, 3), dtype=np.uint8)
    photo = Image.fromarray(pixels)
    for name in ("photo.jpg", "photo.webp"):
        photo.save(tmp_path / name)
    photo.convert("CMYK").save(tmp_path / "print.jpg")
    turned = Image.Exif()
    turned[0x0112] = 6
    photo.save(tmp_path / "turned.jpg", exif=turned)
    whole = (tmp_path / "photo.jpg").read_bytes()
    (tmp_path / "short.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.jpg").write_text("this is no picture")
    (error,), _ = problems(tmp_path, f'backplate = "{written}"')
    assert error.startswith(f"film.toml:10 set.backplate: {expected.format(folder=tmp_path)}")


def test_a_backplate_beside_another_background_is_refused(tmp_path):
    Image.new("RGB", (64, 36)).save(tmp_path / "photo.png")
    with pytest.raises(JobFileError, match=r'film\.toml:9 set: background = "plain" leaves no place for backplate'):
        problems(tmp_path, 'backplate = "photo.png"\nbackground = "plain"')


SIDES = '[domain]\nmin = [-1, -1, 0]\nmax = [1, 1, 1]\nopen_faces = ["x-", "x+", "y-", "y+"]'


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('hdri = "noon.hdr"\nname = "outdoor"', "11 set.name: has no effect beside hdri"),
        ("rotation_deg = 20", "10 set.rotation_deg: has no effect without hdri"),
        ('hdri = "square.hdr"', "10 set.hdri: is 8 x 8 pixels; a picture of the whole sphere is twice as wide"),
        ('backplate = "square.png"', "10 set.backplate: is 64 x 64 pixels; 44 % of it is cut off to fill 1280 x 720"),
        ('backplate = "photo.png"\n[camera]\norbit_deg_per_s = 5.0', "10 set.backplate: stands still behind a camera"),
        ('backplate = "photo.png"\nground = "wood"', "11 set.ground: is seen in reflections only, as backplate"),
        ('background = "plain"\nground = "wood"', '11 set.ground: is seen in reflections only ... "plain"'),
        (f"tank = true\n{SIDES}", "10 set.tank: has no effect, as all sides of the domain are open"),
    ],
)
def test_keys_of_a_set_without_effect_are_warned_of(tmp_path, keys, expected):
    write_hdr(tmp_path / "noon.hdr", np.ones((8, 16, 3)))
    write_hdr(tmp_path / "square.hdr", np.ones((8, 8, 3)))
    Image.new("RGB", (64, 64)).save(tmp_path / "square.png")
    Image.new("RGB", (64, 36)).save(tmp_path / "photo.png")
    errors, (warning,) = problems(tmp_path, keys)
    assert errors == []
    assert says(warning, f"film.toml:{expected}")
    assert problems(tmp_path, "tank = true\n" + SIDES.replace(', "y+"', "")) == ([], [])


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('name = "night"\nsun_elevation_deg = 20', '11 set.sun_elevation_deg: ... "night", which has no sun'),
        ("sun_azimuth_deg = 20", '10 set.sun_azimuth_deg: ... "studio", which has no sun'),
        ('hdri = "noon.hdr"\nsun_azimuth_deg = 20', "11 set.sun_azimuth_deg: has no effect beside hdri"),
        ('backplate = "photo.png"\n[render]\nformat = "png16"', '10 set.backplate: ... 8 bits ... "png16"'),
        ('background = "plain"\n[render]\nformat = "png16"', '10 set.background: is "plain" ... 8 bits ... "png16"'),
    ],
)
def test_keys_of_a_set_that_contradict_each_other_are_refused(tmp_path, keys, expected):
    Image.new("RGB", (64, 36)).save(tmp_path / "photo.png")
    write_hdr(tmp_path / "noon.hdr", np.ones((8, 16, 3)))
    (error,), _ = problems(tmp_path, keys)
    assert says(error, f"film.toml:{expected}")


@pytest.mark.parametrize(
    "keys",
    [
        'name = "outdoor"\nsun_elevation_deg = 20\nsun_azimuth_deg = -90',
        'background = "transparent"\n[render]\nformat = "png16"',
    ],
)
def test_keys_of_a_set_that_go_together_pass_without_a_word(tmp_path, keys):
    assert problems(tmp_path, keys) == ([], [])


@pytest.mark.parametrize(
    ("keys", "meant"),
    [('name = "windw"', "window"), ('ground = "wod"', "wood"), ('background = "transparant"', "transparent")],
)
def test_misspelt_sets_get_a_suggestion(tmp_path, keys, meant):
    with pytest.raises(Exception, match=f'did you mean "{meant}"') as error:
        problems(tmp_path, keys)
    assert "film.toml:10 set." in str(error.value)


BLEND = BALL.replace("[set]", "[material.ball]")


def test_pictures_and_materials_beside_the_job_are_found_and_kept_with_it(tmp_path):
    content = write_hdr(tmp_path / "noon.hdr", np.ones((8, 16, 3)))
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    text = BALL + 'hdri = "noon.hdr"\n[material.ball]\nblend = "own.blend:Old gold"'
    assert checked(text, tmp_path / "film.toml")[:2] == ([], [])
    layout = JobLayout(tmp_path / "renders" / "film")
    _, text = keep_inputs(read_job(tmp_path / "film.toml"), layout)
    layout.job_file.write_text(text)
    (tmp_path / "noon.hdr").unlink()
    moved = layout.root.rename(tmp_path / "elsewhere")
    job = load_job(moved / "job.toml")
    hdri, (blend, name) = Path(job.set.hdri or ""), split_blend(job.material["ball"].blend or "")
    assert hdri.read_bytes() == content
    assert (Path(blend).read_bytes(), name) == (b"BLENDER", "Old gold")
    assert hdri.parent.samefile(moved / "inputs") and Path(blend).parent.samefile(moved / "inputs")


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('blend = "on.blend:Gold"', 'no such file: {folder}/on.blend; did you mean "own.blend"?'),
        ('blend = "own.blend"', "film.toml:10 material.ball.blend: must name a file and a material in it, such as"),
        ('blend = "own.blend:Gold"\nlook = "metal"', "give look or blend, one of them"),
        ("", 'material.ball: says nothing; give a key, such as look = "metal"'),
    ],
)
def test_a_material_that_is_not_one_is_refused(tmp_path, keys, expected):
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    try:
        errors = checked(BLEND + keys, tmp_path / "film.toml").errors
    except JobFileError as error:
        errors = error.problems
    (problem,) = errors
    assert expected.format(folder=tmp_path) in problem


def test_keys_beside_a_material_of_a_file_are_warned_of(tmp_path):
    (tmp_path / "own.blend").write_bytes(b"BLENDER")
    errors, (warning,), _ = checked(BLEND + 'blend = "own.blend:Gold"\nroughness = 0.3', tmp_path / "film.toml")
    assert errors == []
    assert warning.startswith("film.toml:11 material.ball.roughness: has no effect beside blend")


@pytest.mark.parametrize(
    ("light", "exposure", "has_warning"),
    [
        ('type = "sun"', 0.0, False),
        ('type = "sun"\npower = 100', 0.0, True),
        ('type = "sun"\npower = 100', -4.0, False),
        ('type = "sun"', 3.0, True),
        ("power = 100", 0.0, False),
    ],
)
def test_a_sun_that_burns_the_picture_is_warned_of(tmp_path, light, exposure, has_warning):
    text = f'name = "outdoor"\n[render]\nexposure = {exposure}\n[[light]]\nposition = [1, 0, 1]\n{light}'
    errors, warnings = problems(tmp_path, text)
    assert errors == []
    assert [("which burns the picture white" in warning) for warning in warnings] == [True] * has_warning


def test_the_size_of_a_sun_is_an_angle(tmp_path):
    with pytest.raises(JobFileError, match="size of a sun is an angle of at most 180 degrees, got 200"):
        problems(tmp_path, '[[light]]\nposition = [1, 0, 1]\ntype = "sun"\nsize = 200')


def test_a_picture_is_what_its_name_says(tmp_path):
    """A PNG has no sun, and a list of other files is none of its own."""
    Image.new("RGB", (16, 8), (90, 120, 200)).save(tmp_path / "sky.png")
    (tmp_path / "sky.png").rename(tmp_path / "renamed.hdr")
    (tmp_path / "list.hdr").write_text("ffconcat version 1.0\nfile renamed.hdr\n")
    for name in ("renamed.hdr", "list.hdr"):
        (error,) = problems(tmp_path, f'hdri = "{name}"')[0]
        assert f"{name}: cannot be decoded" in error or f"{name}: holds no picture" in error
