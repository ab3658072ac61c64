"""EXR masters by the real Cycles: linear, with their passes, the same bytes in every process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from blender_scenes import BALL, RESOLUTION, read, redness, spec_of, sphere, write_mesh
from blender_stand_in import write_blender_stand_in
from checked_pictures import validate_picture
from exr_channels import exr_channels
from needed_blender import needs_bpy
from warm_python import run_python

from render.blender import open_renderer
from render.errors import InvalidFileError
from render.pictures import read_picture, validate_exr

pytestmark = needs_bpy

PASSES = ("depth", "vector", "normal", "cryptomatte", "denoising")
LAYER = "ViewLayer.Combined"

RENDER_MASTER = """
    import sys
    from pathlib import Path
    from render.blender import open_renderer
    folder = Path(sys.argv[1])
    renderer = open_renderer(folder / "spec.json", threads=1, blender=None)
    renderer.render(0, folder / "first.png", folder / "first.exr" if "exr" in sys.argv else None)
"""


def channels(path: Path, layer: str = "") -> np.ndarray:
    """Red, green and blue of a layer, (height, width, 3)."""
    decoder = av.CodecContext.create("exr", "r")
    decoder.options = {"layer": layer} if layer else {}
    (frame,) = [*decoder.decode(av.Packet(path.read_bytes())), *decoder.decode(None)]
    kind = np.float16 if "f16" in frame.format.name else np.float32
    green, blue, red = (
        np.frombuffer(memoryview(plane), kind).reshape(frame.height, -1)[:, : frame.width]
        for plane in list(frame.planes)[:3]
    )
    return np.stack([red, green, blue], axis=-1).astype(float)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A ball that flies along x at 6 m/s, drawn with all passes by the module."""
    return draw(tmp_path_factory.mktemp("exr"), format="exr", passes=PASSES, motion_blur=False, denoise=True)


def draw(folder: Path, **render: Any) -> Path:
    write_mesh(folder / "ball/000000.ply", *sphere((0.0, 0.0, 0.5), 0.3), velocity=(6.0, 0.0, 0.0))
    spec_of(BALL, **render).write(folder / "spec.json")
    run_python(RENDER_MASTER, str(folder), render["format"])
    return folder


def test_an_executable_with_other_threads_writes_the_same_bytes_as_the_module(folder, tmp_path):
    renderer = open_renderer(folder / "spec.json", threads=2, blender=str(write_blender_stand_in(tmp_path)))
    try:
        renderer.render(0, tmp_path / "a picture.png", tmp_path / "a master.exr")
    finally:
        renderer.close()
    assert (tmp_path / "a master.exr").read_bytes() == (folder / "first.exr").read_bytes()
    assert (tmp_path / "a picture.png").read_bytes() == (folder / "first.png").read_bytes()


def test_the_master_shows_in_linear_light_what_the_picture_shows(folder):
    validate_exr(folder / "first.exr", RESOLUTION, layer=LAYER)
    validate_picture(folder / "first.png", RESOLUTION)
    master, picture = channels(folder / "first.exr", LAYER), read(folder / "first.png")
    # The ball alone is mostly red; its rim mixes with the grey stage, in linear light a little otherwise.
    in_master, in_picture = redness(1000.0 * master) > 0.6, redness(picture) > 0.45
    assert in_picture.sum() > 100
    assert (in_master != in_picture).sum() < 0.15 * in_picture.sum()
    # A view's transform keeps order: where the stage is brighter in the one, it is in the other.
    stage = ~(in_master | in_picture)
    luminance = [each[stage] @ (0.2126, 0.7152, 0.0722) for each in (master, picture)]
    assert np.corrcoef(np.argsort(np.argsort(luminance)))[0, 1] > 0.95


def test_passes_hold_what_they_promise(folder, tmp_path):
    channels = exr_channels(folder / "first.exr", tmp_path)
    middle = {name: channel[RESOLUTION[1] // 2, RESOLUTION[0] // 2] for name, channel in channels.items()}
    # The camera is 2.5 m from the ball's middle, whose radius is 0.3 m. A sphere of 48 segments is 0.2 % flatter.
    assert middle["ViewLayer.Depth.Z"] == pytest.approx(2.2, abs=0.01)
    assert middle["ViewLayer.Normal.Y"] == pytest.approx(-1.0, abs=0.05)
    # 0.1 m a frame in a plane 2.2 m away: 64 pixels x 50 mm / 36 mm / 2.2 m = 40.4 pixels a metre.
    assert abs(middle["ViewLayer.Vector.X"]) == pytest.approx(4.04, abs=0.15)
    assert abs(middle["ViewLayer.Vector.Y"]) < 0.1
    assert middle["ViewLayer.CryptoObject00.g"] == pytest.approx(1.0, abs=0.01)
    assert "ViewLayer.Noisy Image.R" in middle


def test_without_passes_the_master_is_one_picture(tmp_path):
    draw(tmp_path, format="exr")
    validate_exr(tmp_path / "first.exr", RESOLUTION)
    assert (redness(1000.0 * channels(tmp_path / "first.exr")) > 0.6).sum() > 100


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.99])
def test_a_truncated_master_is_refused(folder, tmp_path, kept):
    content = (folder / "first.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InvalidFileError):
        validate_exr(tmp_path / "cut.exr", RESOLUTION, layer=LAYER)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_a_flipped_byte_of_a_master_with_passes_is_seen(folder, tmp_path, place):
    content = bytearray((folder / "first.exr").read_bytes())
    content[int(place * len(content))] ^= 0x10
    (tmp_path / "flipped.exr").write_bytes(content)
    with pytest.raises(InvalidFileError, match="damaged EXR file"):
        validate_exr(tmp_path / "flipped.exr", RESOLUTION, layer=LAYER)


def test_a_master_of_another_size_is_refused(folder):
    with pytest.raises(InvalidFileError, match="is 64x36 pixels, but 64x48 were asked for"):
        validate_exr(folder / "first.exr", (64, 48), layer=LAYER)


def test_a_png_of_sixteen_bits_has_them(tmp_path):
    path = draw(tmp_path, format="png16") / "first.png"
    validate_picture(path, RESOLUTION)
    assert read_picture(path).dtype == np.uint16
