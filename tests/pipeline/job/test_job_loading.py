"""Job files that are wrong, and the lines that say so; and that nothing but such lines ever comes out."""

import random
import shlex
import tomllib
from pathlib import Path
from typing import get_args

import pytest
import tomlkit
from checked_jobs import says
from hypothesis import given, settings
from hypothesis import strategies as st
from places import PROJECT

from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job, read_job
from pipeline.job.starter import TEMPLATES, starter
from pipeline.model.job import Job
from pipeline.model.problems import quoted_list
from pipeline.run.checked_job import check_job
from render.parameters import Look

FLUID = """
[[fluid]]
name = "water"
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
"""


def problems_of(text: str, tmp_path: Path, *overrides: str, preview: bool = False) -> list[str]:
    path = tmp_path / "dam.toml"
    path.write_text(text)
    with pytest.raises(JobFileError) as error:
        read_job(path, overrides, preview=preview)
    return error.value.problems


RIGID = '[[rigid]]\nname = "r"\n'
CLOTH = '[[cloth]]\nname = "c"\nshape = {type = "rectangle", size = [1.0, 1.0], counts = [9, 9]}\n'
SHAPES = (
    "types are box, sphere, cylinder, capsule, torus, cone, revolved, duck, bunny, mesh, animation, compound, piece"
)

BAD = {
    # Keys that are not there.
    "[render]\nsampels = 4": '3 render.sampels: unknown key "sampels"; did you mean "samples"?',
    f'{RIGID}shape = {{type = "sphere", radius = 1, heigt = 2}}': "4 rigid[0].shape.heigt: ... known here: type",
    "[domain]\nfps = 60": '3 domain.fps: unknown key "fps"; it belongs to the top of the file, above the first [table]',
    'quality = "final"': '2 quality: unknown key "quality"; it belongs to [render]',
    # Numbers out of bounds, of the unit of their key or of its vector.
    FLUID.replace('"water"', '"water"\nrest_density = -5'): "5 fluid[0].rest_density: must be > 0 kg/m³, got -5",
    f'{RIGID}shape = {{type = "box", size = [1, 0, 1]}}': "4 rigid[0].shape.size[1]: must be > 0 m, got 0",
    "[render]\nseed = 3000000000": "3 render.seed: must be < 2147483648, got 3000000000",
    "[movie]\nplayback_fps = 0.0001": "3 movie.playback_fps: must be >= 0.01, got 0.0001",
    "frames = 0": "2 frames: must be >= 1, got 0",
    FLUID.replace('"water"', '"water"\ndt = -1'): "5 fluid[0].dt: must be > 0 s, got -1",
    "duration = inf": "2 duration: must be finite, got inf",
    "gravity = [0, 0, nan]": "2 gravity[2]: must be finite, got nan",
    # Values of another type.
    "frames = 2.5": "2 frames: expected a whole number, got 2.5",
    'fps = "60"': '2 fps: expected a whole number, got the text "60"',
    '[render]\ndenoise = "yes"': '3 render.denoise: expected true or false, got the text "yes"',
    "duration = 2020-02-29": "2 duration: expected a number, got 2020-02-29",
    "gravity = [0, 1]": "2 gravity: expected 3 values, got 2",
    "gravity = [0, 1, 2, 3]": "2 gravity: expected 3 values, got 4",
    "gravity = 9.81": "2 gravity: expected a list, got 9.81",
    '[smoke]\nname = "s"': "2 smoke: expected a list, got a table; write [[smoke]], in two brackets",
    FLUID.replace('"water"', '"water"\ndt = "fast"'): '5 fluid[0].dt: expected "adaptive" or a number, got the text',
    # Choices and types that do not exist.
    f'{RIGID}shape = {{type = "spere", radius = 1}}': f'4 rigid[0].shape: unknown type "spere", {SHAPES}; did you mean',
    f"{RIGID}shape = {{radius = 1}}": f'4 rigid[0].shape: missing key "type"; {SHAPES}',
    f'{CLOTH}[[cloth.pin]]\nregion = {{typf = "box"}}': '6 cloth[0].pin[0].region: missing key "type"; types are box',
    f'{RIGID}shape = {{type = "sphere"}}': '4 rigid[0].shape: missing key "radius" (Radius [m])',
    '[render]\nquality = "fnal"': '3 render.quality: expected "draft", "preview" or "final" ... did you mean "final"?',
    '[material.dam]\nlook = "hony"': f'3 material.dam.look: expected {quoted_list(get_args(Look))} ... mean "honey"?',
    f'{CLOTH}material = "wool"': '5 cloth[0].material: expected "cotton", "silk", "denim" or "rubber" ... "wool"',
    f'{CLOTH}[[cloth.pin]]\ncorner = "x-"': '6 cloth[0].pin[0].corner: ... got the text "x-"; did you mean "x-y-"?',
    # Rules between keys.
    FLUID.replace('"water"', '"water"\nsolver = "dfsph"\nsound_speed = 20'): '3 fluid[0]: ... solver = "wcsph"',
    f'{RIGID}kind = "dynamic"\nshape = {{type = "sphere", radius = 1}}': "2 rigid[0]: density is missing",
    CLOTH.replace(", counts = [9, 9]", ""): "4 cloth[0].shape: give counts or resolution, one of them",
    "[domain]\nmin = [1, 0, 0]\nmax = [0, 1, 1]": "2 domain: max must be above min ... x from 1 to 0 m",
    '[domain]\nopen_faces = ["z+", "x-", "z+"]': '3 domain.open_faces: names "z+" more than once',
    '[[fluid]]\nname = "w"\nblock = []': "2 fluid[0]: has neither a block nor an emitter; add [[fluid.block]]",
    # Texts that are no TOML.
    "fps = fast": '2:7 invalid value: fps = fast; a text needs quotes: fps = "fast"',
    'look = "dam': '2:12 unterminated string: look = "dam',
    'name = "dam"': '2:13 cannot overwrite a value: name = "dam"; this key has a value already',
}


@pytest.mark.parametrize("text", BAD)
def test_what_is_wrong_in_a_job_file_is_told_in_one_line(text, tmp_path):
    (problem,) = problems_of(f'name = "dam"\n{text}', tmp_path)
    assert says(problem, f"dam.toml:{BAD[text]}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("frames = 3", 'missing key "name" (Name of the job and of its folder under renders/)'),
        ("a = " + "[" * 3000 + "]" * 3000, "nested too deeply"),
        pytest.param(".".join("a" * 100_000) + " = 1", "nested too deeply", id="dotted key"),
        pytest.param(f"frames = {'9' * 6000}", "a whole number has more than 4300 digits", id="6000 digits"),
    ],
)
def test_what_is_wrong_with_the_whole_job_is_told_without_a_line(text, expected, tmp_path):
    assert problems_of(text, tmp_path) == [f"dam.toml: {expected}"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("duration = 1e300", "dam.toml:2 duration: 1e+300 s at 60 fps are more than 1,000,000 frames"),
        ("duration = 1\nframes = 3", "dam.toml:2 duration: give frames or duration, not both"),
    ],
)
def test_a_rule_of_the_whole_job_is_told_of_the_key_that_breaks_it(text, expected, tmp_path):
    assert problems_of(f'name = "dam"\n{text}', tmp_path) == [expected]


def test_a_job_file_may_say_the_version_of_its_keys(tmp_path):
    assert problems_of('name = "dam"\nversion = 2', tmp_path) == ["dam.toml:2 version: expected 1, got 2"]
    path = tmp_path / "dam.toml"
    path.write_text('version = 1\nname = "dam"\n')
    assert load_job(path).version == 1


def test_dots_in_texts_and_comments_are_no_depth(tmp_path):
    dots = "." * 100
    comments = f"# {dots} don't\nname = \"dam\" # 'it's {dots}\n"
    (problem,) = problems_of(f'{comments}[material]\nwall = \'{dots}\'\nb = """\n\\"{dots}"""\n', tmp_path)[:1]
    assert "nested" not in problem


def test_a_large_value_of_an_unknown_key_is_told_at_once(tmp_path):
    (problem,) = problems_of(f'name = "dam"\nwhat = [{"1, " * 300_000}]', tmp_path)
    assert problem.startswith('dam.toml:2 what: unknown key "what"')
    (problem,) = problems_of(f'name = "dam"\nwhat = [{"1, " * 2_000_000}]', tmp_path)
    assert problem.endswith("6 MB is not a job file; a few KB are usual")


def test_the_job_file_of_a_folder_that_was_damaged_is_told_with_that_of_its_last_run(tmp_path):
    layout = JobLayout(tmp_path)
    layout.job_text("0" * 64).parent.mkdir(parents=True)
    layout.job_text("0" * 64).write_text('name = "dam"')
    (tmp_path / ".provenance" / "jobs" / "$(x).toml").write_text("somebody's")
    for damage in (b'name = "d\xe1m"', b'name ? "dam"'):
        layout.job_file.write_bytes(damage)
        with pytest.raises(JobFileError) as error:
            read_job(layout.job_file)
        (problem,) = error.value.problems
        remedy = shlex.split(problem.partition("is kept: ")[2])
        assert remedy == ["cp", str(layout.job_text("0" * 64)), str(layout.job_file)]


def test_a_name_that_is_no_file_name_is_told_with_the_rule(tmp_path):
    (problem,) = problems_of('name = "a/b"', tmp_path)
    assert says(problem, 'dam.toml:1 name: must begin with a letter or digit ... 100 at most, got the text "a/b"')


def test_all_problems_come_at_once_in_the_order_of_the_file(tmp_path):
    text = "name = 3\nfps = 0\n[render]\nsampels = 4\n[camera]\nf_stop = -1\n[[light]]\n"
    assert problems_of(text, tmp_path) == [
        "dam.toml:1 name: expected a text, got 3",
        "dam.toml:2 fps: must be >= 1, got 0",
        'dam.toml:4 render.sampels: unknown key "sampels"; did you mean "samples"?',
        "dam.toml:6 camera.f_stop: must be > 0, got -1",
        'dam.toml:7 light[0]: missing key "position" (Where it stands [m]; of a sun only the direction counts)',
    ]


def test_missing_file_folder_and_binary_are_named(tmp_path):
    binary = tmp_path / "film.toml"
    binary.write_bytes(b"name = \xff\xfe")
    for path, expected in (
        (tmp_path / "absent.toml", "no such file; `pipeline new NAME` writes a starter"),
        (tmp_path, "is a folder, not a job file"),
        (binary, "not UTF-8 text (byte 7 is 0xff)"),
    ):
        with pytest.raises(JobFileError) as error:
            read_job(path)
        assert error.value.problems == [f"{path}: {expected}"]


def test_windows_line_ends_and_byte_order_mark_do_not_matter(tmp_path):
    path = tmp_path / "dam.toml"
    path.write_bytes(b"\xef\xbb\xbf" + b'name = "dam"\r\nframes = 3\r\n')
    assert load_job(path) == Job(name="dam", frames=3)


def test_a_blender_named_relative_to_the_job_file_is_found_from_anywhere(tmp_path):
    path = tmp_path / "blender.toml"
    path.write_text('name = "film"\n[render]\nblender = "tools/blender"  # mine\n')
    loaded = read_job(path)
    assert loaded.job.render.blender == (tmp_path / "tools" / "blender").as_posix()
    elsewhere = tmp_path / "renders" / "film" / "job.toml"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text(loaded.text)
    assert load_job(elsewhere) == loaded.job
    assert "# mine" in loaded.text


def test_mesh_files_are_absolute_in_the_job_and_in_its_text_and_comments_stay(tmp_path):
    path = tmp_path / "dam.toml"
    path.write_text(
        'name = "dam" # mine\n[[rigid]]\nname = "r"\nshape = { type = "mesh", file = "m/duck.obj" } # duck\n'
    )
    loaded = read_job(path)
    assert loaded.job.rigid[0].shape.file == (tmp_path / "m" / "duck.obj").as_posix()
    assert "# mine" in loaded.text
    assert "# duck" in loaded.text
    elsewhere = tmp_path / "renders" / "job.toml"
    elsewhere.parent.mkdir()
    elsewhere.write_text(loaded.text)
    assert read_job(elsewhere).job == loaded.job
    assert read_job(elsewhere).text == loaded.text


def test_text_of_an_unchanged_job_is_the_users_own(tmp_path):
    path = tmp_path / "dam.toml"
    path.write_text(starter("dam", "dam-break", file="dam.toml"))
    assert read_job(path).text == path.read_text()


JOBS = sorted((PROJECT / "jobs").glob("*.toml"))


@pytest.mark.parametrize("path", JOBS, ids=lambda path: path.stem)
def test_every_job_file_of_the_project_loads_and_is_named_after_its_file(path):
    assert load_job(path).name == path.stem


CHEAP_TEMPLATES = [template for template in TEMPLATES if template != "drop"]
"""Building the duck takes a second, and mutations of it find nothing new."""


def mutated(document: object, choose: random.Random) -> object:
    """The document with one value somewhere replaced, removed, renamed or wrapped."""
    junk = [0, -1, 1e308, float("nan"), "", "x", True, [], {}, [[1]], {"type": "box"}, 10**30, ["a"] * 5]
    if isinstance(document, dict) and document:
        key = choose.choice(sorted(document))
        match choose.randrange(6):
            case 0:
                return {**document, key: choose.choice(junk)}
            case 1:
                return {name: value for name, value in document.items() if name != key}
            case 2:
                return {(f"{name}e" if name == key else name): value for name, value in document.items()}
            case _:
                return {**document, key: mutated(document[key], choose)}
    if isinstance(document, list) and document and choose.random() < 0.8:
        index = choose.randrange(len(document))
        return [*document[:index], mutated(document[index], choose), *document[index + 1 :]]
    return choose.choice(junk)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    template=st.sampled_from(CHEAP_TEMPLATES),
    preview=st.booleans(),
    count=st.integers(1, 4),
)
def test_whatever_values_a_job_holds_it_loads_or_gives_lines(tmp_path_factory, seed, template, preview, count):
    choose = random.Random(seed)
    document = tomllib.loads(starter("dam", template, file="dam.toml"))
    for _ in range(count):
        document = mutated(document, choose)
    path = tmp_path_factory.getbasetemp() / "mutated.toml"
    path.write_text(tomlkit.dumps(document if isinstance(document, dict) else {"name": document}))
    assert_loads_or_gives_lines(path, preview=preview)


@settings(max_examples=200, deadline=None)
@given(data=st.data(), template=st.sampled_from(CHEAP_TEMPLATES))
def test_whatever_is_typed_into_a_job_file_it_loads_or_gives_lines(tmp_path_factory, data, template):
    text = starter("dam", template, file="dam.toml")
    at = data.draw(st.integers(0, len(text)))
    removed = data.draw(st.integers(0, 20))
    typed = data.draw(st.text(st.sampled_from(sorted("[]{}=.,\"'#\n\\ -_e0aé")), max_size=4))
    path = tmp_path_factory.getbasetemp() / "typed.toml"
    path.write_text(text[:at] + typed + text[at + removed :], encoding="utf-8")
    assert_loads_or_gives_lines(path, preview=False)


def assert_loads_or_gives_lines(path: Path, *, preview: bool) -> None:
    try:
        loaded = read_job(path, preview=preview)
    except JobFileError as error:
        assert error.problems
        assert all(problem.startswith((path.name, str(path), "--preview")) for problem in error.problems)
        assert not any("\n" in problem for problem in error.problems)
    else:
        findings = check_job(loaded.job, memory_bytes=20_000 * 1024)
        lines = loaded.source.describe_all([*findings.errors, *findings.warnings])
        assert not any("\n" in line for line in lines)
