"""What an HDRI and the textures of .blend files add to the memory of a renderer."""

import tracemalloc
from math import prod
from pathlib import Path

import numpy as np
import pytest
from fresh_python import run_python
from needed_blender import needs_bpy
from PIL import Image
from radiance_pictures import write_hdr

from pipeline.base.layout import JobLayout
from pipeline.model.job import Job
from pipeline.stages.render import BYTES_PER_PIXEL, WORKER_BYTES, RenderStage
from pipeline.stages.render_scene import render_spec
from pipeline.stages.texture_memory import LIGHT_MAP_BYTES, bytes_of_textures, own_picture_bytes
from render.blend_file import Texture, read_textures
from render.environment import environment_pixels, read_environment_size
from render.parameters import SetParameters

BALL = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}}

WRITE = """
    import sys
    import bpy

    folder = sys.argv[1]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    image = bpy.data.images.new("sky", 48, 24, float_buffer=True)
    settings = bpy.context.scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format = "OPEN_EXR"
    image.save_render(folder + "/sky.exr", scene=bpy.context.scene)

    def new(name, *pictures):
        material = bpy.data.materials.new(name)
        material.use_fake_user = True
        for picture in pictures:
            texture = material.node_tree.nodes.new("ShaderNodeTexImage")
            texture.image = picture

    bricks = bpy.data.images.new("bricks", 64, 32)
    relief = bpy.data.images.new("relief", 16, 8, float_buffer=True)
    for picture in (bricks, relief):
        picture.pixels.foreach_set([0.5] * (4 * picture.size[0] * picture.size[1]))
        picture.pack()
    new("Wall", bricks, bricks, relief)
    new("Floor", bricks)
    new("Plain")
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/materials.blend")
"""


def job(hdri: Path | None = None, **blends: str) -> Job:
    stage = {} if hdri is None else {"hdri": str(hdri)}
    rigid = [{**BALL, "name": name} for name in blends] or [BALL]
    material = {name: {"blend": blend} for name, blend in blends.items()}
    return Job.model_validate({"name": "film", "rigid": rigid, "material": material, "set": stage})


def needed(hdri: Path | None = None, **blends: str) -> int:
    return own_picture_bytes(render_spec(job(hdri, **blends), JobLayout(Path("film"))))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    run_python(WRITE, str(folder))
    return folder


@pytest.mark.parametrize("size", [(2, 4), (7, 30)])
def test_a_radiance_picture_tells_its_pixels_by_its_header(tmp_path, size):
    write_hdr(tmp_path / "noon.hdr", np.ones((*size, 3)))
    assert environment_pixels(tmp_path / "noon.hdr") == prod(size)


@needs_bpy
def test_an_openexr_picture_tells_its_pixels_by_its_header(files):
    assert environment_pixels(files / "sky.exr") == prod(read_environment_size(files / "sky.exr")) == 48 * 24


@pytest.mark.parametrize("content", [b"", b"#?RADIANCE\n", b"v/1\x01", b"dataWindow\0box2i\0\x10\0\0\0short"])
@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_a_header_without_a_size_tells_none(tmp_path, content, suffix):
    path = (tmp_path / "noon").with_suffix(suffix)
    path.write_bytes(content)
    assert environment_pixels(path) is None


def test_an_hdri_is_counted_in_the_memory_of_each_renderer(tmp_path):
    write_hdr(tmp_path / "noon.hdr", np.ones((32, 64, 3)))

    def need(job: Job) -> int:
        (task, *_) = RenderStage().plan(job, JobLayout(tmp_path / "job"))
        return task.resources.memory_bytes

    assert need(job()) == WORKER_BYTES + BYTES_PER_PIXEL * 1280 * 720
    # A picture in Blender and one in Cycles, of four floats or halves a pixel.
    assert need(job(tmp_path / "noon.hdr")) - need(job()) - LIGHT_MAP_BYTES >= (16 + 8) * 32 * 64


def test_a_backplate_is_counted_in_the_memory_of_each_renderer(tmp_path):
    Image.new("RGB", (64, 32)).save(tmp_path / "photo.png")
    backplate = {"set": SetParameters(backplate=str(tmp_path / "photo.png"))}
    spec = render_spec(job().model_copy(update=backplate), JobLayout(Path("film")))
    assert own_picture_bytes(spec) >= 16 * 32 * 64  # floats, as Blender holds a picture of 16 bits


def test_a_texture_counts_by_what_its_pixels_are():
    small, large = bytes_of_textures([Texture(64, 32, False)]), bytes_of_textures([Texture(64, 32, True)])
    assert small >= 2 * 4 * 64 * 32
    assert large >= 2 * 16 * 64 * 32
    assert bytes_of_textures([Texture(64, 32, False), Texture(64, 32, True)]) == small + large


@needs_bpy
def test_the_textures_of_a_material_count_once_for_each_body_that_has_it(files, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    bricks, relief = Texture(64, 32, False), Texture(16, 8, True)
    blend = files / "materials.blend"
    assert sorted(read_textures(blend, "Wall", None)) == sorted([bricks, relief])
    assert read_textures(blend, "Plain", None) == read_textures(blend, "Absent", None) == []
    wall, floor = bytes_of_textures([bricks, relief]), bytes_of_textures([bricks])
    assert needed(a=f"{blend}:Wall", b=f"{blend}:Floor", c=f"{blend}:Floor") == wall + 2 * floor
    kept = [int(path.read_text()) for path in (tmp_path / "physics-pipeline" / "blend-textures").iterdir()]
    assert sorted(kept) == sorted([wall, floor])


@needs_bpy
def test_what_blender_has_told_once_is_not_asked_again_in_another_process(files, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, copy = tmp_path / "first.blend", tmp_path / "copy.blend"
    for path in (first, copy):
        path.write_bytes((files / "materials.blend").read_bytes())
    told = needed(a=f"{first}:Wall")
    assert told == bytes_of_textures([Texture(64, 32, False), Texture(16, 8, True)])
    own = next((tmp_path / "physics-pipeline" / "blend-textures").iterdir())
    own.write_text("12345")
    assert needed(a=f"{copy}:Wall") == 12345  # by its content, wherever it lies


def test_what_cannot_be_read_counts_for_nothing(tmp_path):
    (tmp_path / "text.blend").write_text("no Blender file")
    assert needed(tmp_path / "absent.hdr", a=f"{tmp_path / 'absent.blend'}:Wall") == 0
    assert needed(a=f"{tmp_path / 'text.blend'}:Wall") == 0


def test_a_large_blend_file_is_not_read_into_memory(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    size = 64_000_000
    blend = tmp_path / "large.blend"
    with blend.open("wb") as file:
        file.truncate(size)
    tracemalloc.start()
    try:
        assert needed(a=f"{blend}:Wall") == 0
        assert tracemalloc.get_traced_memory()[1] < size / 4  # it is read in pieces of 4 MiB
    finally:
        tracemalloc.stop()
