"""Pictures: what counts as a rendered frame, and what two frames have in common."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from checked_pictures import validate_picture
from PIL import Image

from render.errors import InvalidFileError
from render.pictures import read_picture, read_rgb8

SIZE = (40, 30)


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)


def save(path: Path, pixels: np.ndarray, **options) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


def save_16_bit(path: Path, pixels: np.ndarray) -> Path:
    """A PNG of 16 bits a channel, chunk by chunk: Pillow writes none in colour."""
    height, width, channels = pixels.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    content = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    return path


def test_statistics_are_those_of_the_pixels(tmp_path, pixels):
    statistics = validate_picture(save(tmp_path / "frame.png", pixels), SIZE)
    luminance = pixels @ np.array([0.2126, 0.7152, 0.0722]) / 255
    assert statistics.mean_luminance == pytest.approx(luminance.mean())
    assert statistics.white_share == pytest.approx((pixels.min(axis=2) >= 245).mean())


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_all_sixteen_bits_are_read(tmp_path, channels):
    deep = np.random.default_rng(4).integers(0, 65536, (SIZE[1], SIZE[0], channels)).astype(np.uint16)
    path = save_16_bit(tmp_path / "frame.png", deep)
    np.testing.assert_array_equal(read_picture(path), deep)
    validate_picture(path, SIZE)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_eight_bits_are_read_as_they_are(tmp_path, pixels, mode):
    image = Image.fromarray(pixels).convert(mode)
    image.save(tmp_path / "frame.png")
    np.testing.assert_array_equal(
        read_picture(tmp_path / "frame.png"), np.asarray(image).reshape(SIZE[1], SIZE[0], len(image.getbands()))
    )


def test_sixteen_bits_round_to_eight(tmp_path, pixels):
    path = save_16_bit(tmp_path / "frame.png", pixels.astype(np.uint16) * 257 + 100)
    np.testing.assert_array_equal(read_rgb8(path)[pixels < 255], pixels[pixels < 255])


@pytest.mark.parametrize("mode", ["LA", "RGBA"])
def test_what_has_alpha_is_laid_over_black(tmp_path, pixels, mode):
    image = Image.fromarray(pixels).convert(mode)
    alpha = Image.linear_gradient("L").resize(image.size)
    image.putalpha(alpha)
    image.save(tmp_path / "frame.png")
    black = Image.new("RGBA", image.size, "black")
    expected = np.asarray(Image.alpha_composite(black, image.convert("RGBA")).convert("RGB"))
    # Pillow rounds its products of eight bits in its own way.
    np.testing.assert_allclose(read_rgb8(tmp_path / "frame.png").astype(int), expected.astype(int), atol=1)


def test_another_size_is_refused(tmp_path, pixels):
    with pytest.raises(InvalidFileError, match=r"frame\.png: is 40x30 pixels, but 40x32 were asked for"):
        validate_picture(save(tmp_path / "frame.png", pixels), (40, 32))


@pytest.mark.parametrize(
    ("color", "reason"),
    [((0, 0, 0), "is black"), ((12, 200, 30), r"one colour only: \[12, 200, 30\]"), ((255, 255, 255), "one colour")],
)
def test_a_frame_that_shows_nothing_is_refused(tmp_path, color, reason):
    Image.new("RGB", SIZE, color).save(tmp_path / "frame.png")
    with pytest.raises(InvalidFileError, match=reason):
        validate_picture(tmp_path / "frame.png", SIZE)


def test_alpha_does_not_save_a_plain_frame(tmp_path, pixels):
    plain = np.full((SIZE[1], SIZE[0], 4), 90, np.uint8)
    plain[..., 3] = pixels[..., 0]
    with pytest.raises(InvalidFileError, match="one colour"):
        validate_picture(save(tmp_path / "frame.png", plain), SIZE)


@pytest.mark.parametrize("kept", [0, 10, 40, 0.3, 0.9, -13])
def test_a_truncated_picture_is_refused(tmp_path, pixels, kept):
    path = save(tmp_path / "frame.png", pixels)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(InvalidFileError):
        validate_picture(path, SIZE)


@pytest.mark.parametrize("bits", [8, 16])
def test_a_damaged_picture_is_refused(tmp_path, pixels, bits):
    path = tmp_path / "frame.png"
    if bits == 8:
        save(path, pixels)
    else:
        save_16_bit(path, pixels.astype(np.uint16) * 257)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(InvalidFileError):
        validate_picture(path, SIZE)


def test_what_is_not_a_png_is_refused(tmp_path, pixels):
    save(tmp_path / "frame.jpg", pixels)
    with pytest.raises(InvalidFileError, match="not a PNG"):
        validate_picture(tmp_path / "frame.jpg", SIZE)
