"""EXR headers: what varies from run to run goes, and the pixels are still found."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from blender_scripts.exr import Attribute, read_layout, strip_metadata

STAMPS = (
    Attribute(b"Date", b"string", b"2026/01/31 23:59:59"),
    Attribute(b"RenderTime", b"string", b"01:02:03.04"),
    Attribute(b"cycles.ViewLayer.total_time", b"string", b"00:00.62"),
)


@pytest.fixture
def picture(tmp_path) -> Path:
    """48 by 40 pixels of a ramp, written by FFmpeg."""
    encoder = av.CodecContext.create("exr", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 48, 40, "gbrpf32le", Fraction(1, 60)
    frame = av.VideoFrame(48, 40, "gbrpf32le")
    for plane in frame.planes:
        plane.update(np.linspace(0.0, 4.0, plane.buffer_size // 4, dtype=np.float32).tobytes())
    frame.pts = 0
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    path = tmp_path / "ramp.exr"
    path.write_bytes(b"".join(bytes(packet) for packet in packets))
    return path


def decoded(path: Path) -> np.ndarray:
    decoder = av.CodecContext.create("exr", "r")
    (frame,) = [*decoder.decode(av.Packet(path.read_bytes())), *decoder.decode(None)]
    return np.stack([np.frombuffer(memoryview(plane), np.float32) for plane in frame.planes])


def stamped(content: bytes, attributes: tuple[Attribute, ...]) -> bytes:
    """The same file with more attributes in front of its header."""
    layout = read_layout(content)
    more = b"".join(each.packed() for each in attributes)
    offsets = np.array(layout.offsets, "<u8") + len(more)
    return content[:8] + more + content[8 : layout.tables_at] + offsets.tobytes() + content[min(layout.offsets) :]


def test_stamps_of_two_runs_leave_the_same_bytes_and_every_pixel(tmp_path, picture):
    plain = picture.read_bytes()
    strip_metadata(picture)
    assert picture.read_bytes() == plain
    shown = decoded(picture)
    other = tmp_path / "other.exr"
    other.write_bytes(stamped(plain, STAMPS))
    assert other.read_bytes() != plain
    np.testing.assert_array_equal(decoded(other), shown)
    strip_metadata(other)
    assert other.read_bytes() == plain


def test_what_says_something_about_the_pixels_stays(picture):
    content = stamped(picture.read_bytes(), (Attribute(b"cryptomatte/1/manifest", b"string", b"{}"), *STAMPS))
    picture.write_bytes(content)
    strip_metadata(picture)
    names = {attribute.name for attribute in read_layout(picture.read_bytes()).parts[0]}
    assert {b"cryptomatte/1/manifest", b"channels", b"compression", b"dataWindow"} <= names
    assert not {attribute.name for attribute in STAMPS} & names


@pytest.mark.parametrize("kept", [0, 3, 20, 200, 400])
def test_a_truncated_header_is_refused(picture, kept):
    content = picture.read_bytes()
    assert kept < min(read_layout(content).offsets)
    with pytest.raises(ValueError, match="truncated EXR file" if kept > 3 else "not an EXR file"):
        read_layout(content[:kept])
