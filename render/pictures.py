"""Rendered pictures: every pixel decoded, measured and hashed."""

from __future__ import annotations

import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray
from PIL import Image

from render.errors import InvalidFileError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

BLACK_LUMINANCE = 1.0e-4
"""Mean luminance of display values [-] below which a picture counts as black: one pixel in 10 000 is white."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_CHANNELS_OF_COLOR_TYPE = {0: 1, 2: 3, 4: 2, 6: 4}
_BT709_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class PictureStatistics:
    """What a picture looks like in numbers; display values from 0 to 1.

    Attributes:
        width: [pixels].
        height: [pixels].
        bit_depth: bits a channel.
        mean_luminance: BT.709 weights on display values [-].
        luminance_deviation: standard deviation of the luminance [-].
        darkest: smallest luminance [-].
        brightest: largest luminance [-].
    """

    width: int
    height: int
    bit_depth: int
    mean_luminance: float
    luminance_deviation: float
    darkest: float
    brightest: float


def read_picture(path: Path) -> Pixels:
    """All pixels of a PNG, (height, width, channels), uint8 or uint16; channels are 1, 2, 3 or 4 (alpha last).

    Raises:
        InvalidFileError: it is not a PNG, or it is damaged.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    if content[: len(_PNG_SIGNATURE)] != _PNG_SIGNATURE or len(content) < 33:
        raise InvalidFileError(path, "is not a PNG picture")
    if not content.endswith(_PNG_END):
        raise InvalidFileError(path, "is truncated")
    bit_depth, color_type = content[24], content[25]
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            image.load()
            if bit_depth <= 8:
                pixels = np.asarray(
                    image if image.mode in ("L", "LA", "RGB", "RGBA") else image.convert("RGBA"), np.uint8
                )
                return pixels.reshape(*pixels.shape[:2], -1)
    except (OSError, SyntaxError, ValueError, zlib.error, Image.DecompressionBombError) as error:
        raise InvalidFileError(path, f"cannot be decoded: {error}") from error
    return _read_16_bit(path, content, _CHANNELS_OF_COLOR_TYPE[color_type])


def read_rgb8(path: Path) -> NDArray[np.uint8]:
    """Pixels as (height, width, 3) uint8; 16-bit channels are rounded, what has alpha is laid over black."""
    pixels = read_picture(path)
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    channels = pixels.shape[2]
    color = np.repeat(pixels[..., :1], 3, axis=2) if channels <= 2 else pixels[..., :3]
    if channels in (2, 4):
        color = (color.astype(np.uint16) * pixels[..., -1:] + 127) // 255
    return np.ascontiguousarray(color, np.uint8)


def validate_picture(path: Path, resolution: tuple[int, int]) -> PictureStatistics:
    """Decode a rendered picture and check that it shows something.

    Args:
        path: a PNG of 8 or 16 bits.
        resolution: expected width and height [pixels].

    Raises:
        InvalidFileError: it is damaged, of another size, black, or of one colour only.
        OSError: it cannot be read.
    """
    pixels = read_picture(path)
    height, width, channels = pixels.shape
    if (width, height) != tuple(resolution):
        raise InvalidFileError(path, f"is {width}x{height} pixels, but {resolution[0]}x{resolution[1]} were asked for")
    scale = float(np.iinfo(pixels.dtype).max)
    luminance = pixels[..., :3] @ _BT709_WEIGHTS / scale if channels >= 3 else pixels[..., 0] / scale
    statistics = PictureStatistics(
        width=width,
        height=height,
        bit_depth=8 * pixels.dtype.itemsize,
        mean_luminance=float(luminance.mean()),
        luminance_deviation=float(luminance.std()),
        darkest=float(luminance.min()),
        brightest=float(luminance.max()),
    )
    if statistics.mean_luminance < BLACK_LUMINANCE:
        raise InvalidFileError(path, f"is black (mean luminance {statistics.mean_luminance:.2g})")
    color = pixels[..., :3] if channels >= 3 else pixels[..., :1]
    if (color == color[0, 0]).all():
        raise InvalidFileError(path, f"has one colour only: {color[0, 0].tolist()}")
    return statistics


def pixel_hash(path: Path) -> str:
    """blake3 of the size, the depth and every pixel; the same for pictures that differ in metadata or compression."""
    pixels = np.ascontiguousarray(read_picture(path))
    digest = blake3(f"{pixels.shape} {pixels.dtype.str}".encode())
    digest.update(pixels.tobytes())
    return digest.hexdigest()


def _read_16_bit(path: Path, content: bytes, channels: int) -> NDArray[np.uint16]:
    """Pillow keeps 8 bits of a 16-bit picture; FFmpeg keeps all."""
    import av

    decoder = av.CodecContext.create("png", "r")
    try:
        frames = [*decoder.decode(av.Packet(content)), *decoder.decode(None)]
    except av.FFmpegError as error:
        raise InvalidFileError(path, f"cannot be decoded: {error}") from error
    layout = {1: "gray16be", 2: "ya16be", 3: "rgb48be", 4: "rgba64be"}[channels]
    if [frame.format.name for frame in frames] != [layout]:
        raise InvalidFileError(path, f"cannot be decoded as one picture of {layout} pixels")
    frame = frames[0]
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), ">u2").reshape(frame.height, plane.line_size // 2)
    return rows[:, : frame.width * channels].reshape(frame.height, frame.width, channels).astype(np.uint16)
