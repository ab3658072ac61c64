"""Names of bodies in all scripts: what is one, and that what looks alike is alike."""

import unicodedata
from pathlib import Path

import pytest
from checked_jobs import says

from pipeline.base.errors import JobFileError
from pipeline.job.loading import make_job, read_job
from pipeline.run.checked_job import check_job

WATER = """
name = "dam"
[[fluid]]
name = "{name}"
[[fluid.block]]
shape = {{ type = "box", size = [0.2, 0.2, 0.2] }}
"""


def decomposed(text: str) -> str:
    return unicodedata.normalize("NFD", text)


def read(tmp_path: Path, text: str, *overrides: str):
    path = tmp_path / "dam.toml"
    path.write_text(text, encoding="utf-8")
    return read_job(path, overrides)


@pytest.mark.parametrize("name", ["Öl", "水", "дым-1", "père_2", "นํ้า", "l" * 64])
def test_names_have_letters_of_any_script_and_are_composed(tmp_path: Path, name: str):
    looks = f'[material."{name}"]\nlook = "honey"\n[whitewater."{decomposed(name)}"]\n'
    job = read(tmp_path, WATER.format(name=decomposed(name)) + looks).job
    composed = unicodedata.normalize("NFC", name)
    assert (job.fluid[0].name, [*job.material], [*job.whitewater]) == (composed, [composed], [composed])


@pytest.mark.parametrize(
    "name", ["a/b", "a\\\\b", "..", "a b", "a\\u0000b", "a\\u202eb", "1a", "\\u0308a", "🦆", "l" * 65, ""]
)
def test_what_no_folder_or_page_should_be_called_is_no_name(tmp_path: Path, name: str):
    with pytest.raises(JobFileError) as refused:
        read(tmp_path, WATER.format(name=name))
    (problem,) = refused.value.problems
    assert says(problem, "dam.toml:4 fluid[0].name: must begin with a letter and go on with letters ... got the text")


def test_a_name_has_room_for_an_ending_in_a_folder(tmp_path: Path):
    assert read(tmp_path, WATER.format(name="水" * 64)).job.fluid[0].name == "水" * 64
    with pytest.raises(JobFileError, match="must have 200 bytes at most as UTF-8, got 256"):
        read(tmp_path, WATER.format(name="𠀀" * 64))


def test_two_names_that_differ_in_nothing_to_be_seen_are_refused(tmp_path: Path):
    two = WATER.format(name="Öl") + WATER.format(name=decomposed("Öl")).partition('"dam"')[2]
    assert any('"Öl" is taken by fluid[0]' in each.message for each in check_job(read(tmp_path, two).job).errors)
    looks = f'[material."Öl"]\n[material."{decomposed("Öl")}"]\n'
    with pytest.raises(JobFileError, match=r"material.*is there twice"):
        read(tmp_path, WATER.format(name="Öl") + looks)


def test_an_override_finds_a_name_however_it_is_typed(tmp_path: Path):
    looks = f'[material."{decomposed("Öl")}"]\nroughness = 0.1\n'
    for name in ("Öl", decomposed("Öl")):
        text = WATER.format(name=decomposed("Öl")) + looks
        job = read(tmp_path, text, f"fluid.{name}.viscosity=0.5", f"material.{name}.roughness=0.9").job
        assert (job.fluid[0].viscosity, job.material["Öl"].roughness) == (0.5, 0.9)


def test_files_keep_the_letters_that_their_folder_has(tmp_path: Path):
    mesh = tmp_path / decomposed("möbel.obj")
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shape = {"type": "mesh", "file": str(mesh)}
    job = make_job(name="dam", rigid=[{"name": "möbel", "shape": shape}]).job
    assert job.rigid[0].shape.file == str(mesh)
