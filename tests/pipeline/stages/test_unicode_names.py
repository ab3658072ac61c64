"""A film whose bodies have names of many scripts, and its exports as other programs read them."""

import pytest
from films import JOB, Studio

from pipeline.store.cache import read_frame
from render.gltf_files import read_glb
from render.usd_files import prim_name

pytestmark = pytest.mark.slow

NAMES = {"water": "水", "ball": "мяч", "sheet": "Öl-Tuch", "plume": "дым"}


@pytest.fixture(scope="module")
def studio(tmp_path_factory) -> Studio:
    job = JOB.replace("frames = 6", "frames = 2")
    for plain, name in NAMES.items():
        job = job.replace(f'"{plain}"', f'"{name}"').replace(f"[whitewater.{plain}]", f'[whitewater."{name}"]')
        job = job.replace(f"[material.{plain}]", f'[material."{name}"]')
    studio = Studio.open(tmp_path_factory.mktemp("studio"), job)
    studio.submit()
    return studio


def test_files_groups_and_tasks_have_the_names(studio):
    layout = studio.layout
    assert layout.film.exists()
    assert layout.path(layout.surface("水", 1)).name == "000001.ply"
    assert layout.path(layout.surface("水", 1)).is_file()
    assert set(read_frame(layout.path(layout.frame_cache(1))).bodies) == set(NAMES.values())
    assert "surface/水/000001: done, up to date" in studio.run("explain", "tiny", "surface/水/000001").out
    assert "Öl-Tuch" in studio.run("explain", "tiny", "cloth/O\u0308l-Tuch/000001").assert_code(0).out


def test_usd_has_prims_that_every_reader_takes_with_the_names_to_be_shown(studio):
    from pxr import Usd, UsdValidation

    studio.run("export", "tiny", "--to", "usd").assert_code(0)
    stage = Usd.Stage.Open(str(studio.layout.root / "tiny.usd"))
    shown = {prim.GetDisplayName(): prim.GetName() for prim in stage.GetPrimAtPath("/World").GetChildren()}
    assert set(NAMES.values()) <= set(shown)
    assert all(name.isascii() and name.isidentifier() for name in shown.values())
    assert len(set(shown.values())) == len(shown)
    errors = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(
        stage
    )
    assert [each.GetErrorAsString() for each in errors] == []


def test_prims_of_different_names_differ_and_those_of_ascii_are_as_before():
    names = ["水", "油", "Öl", "Ol", "öl", "a-b", "water.particles"]
    assert len({prim_name(name) for name in names}) == len(names)
    assert [prim_name(name) for name in names[-2:]] == ["a_b", "water_particles"]


def test_vtk_and_gltf_have_the_names(studio):
    from vtkmodules.vtkIOXML import vtkXMLMultiBlockDataReader

    studio.run("export", "tiny", "--to", "vtk").assert_code(0)
    studio.run("export", "tiny", "--to", "gltf").assert_code(0)
    reader = vtkXMLMultiBlockDataReader()
    reader.SetFileName(str(studio.layout.root / "vtk/000001.vtm"))
    reader.Update()
    frame = reader.GetOutput()
    blocks = {frame.GetMetaData(k).Get(frame.NAME()): frame.GetBlock(k) for k in range(frame.GetNumberOfBlocks())}
    assert set(NAMES.values()) <= set(blocks)
    assert all(blocks[name].GetNumberOfPoints() > 0 for name in NAMES.values())
    document, _ = read_glb((studio.layout.root / "tiny.glb").read_bytes())
    assert {"мяч", "Öl-Tuch", "水"} <= {node.get("name") for node in document["nodes"]}
