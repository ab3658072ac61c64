"""Rendered pictures: every pixel decoded and measured."""

from __future__ import annotations

import io
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from render.errors import InvalidFileError, invalid_if_refused

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

BLACK_LUMINANCE = 1.0e-4
"""Mean luminance of display values [-] below which a picture counts as black: one pixel in 10 000 is white."""

FLAT_LEVELS = 1
"""Range of each channel in grey levels of 255 up to which a picture has one colour only: rounding, or little noise."""

WHITE_LEVEL = 245.0 / 255.0
"""Display value [-] from which a channel counts as burnt: the view's curve comes to 1 slowly."""

VISIBLE_LEVELS = 6
"""Grey levels of 255 by which a part of a picture differs from the empty set if something is to be seen there; noise
of a denoised draft, in the mean of a cell of four pixels, reaches 5."""
SHARE_THAT_SHOWS = 0.05
"""Least share of the cells with bodies that must differ from the empty set: a body that is transparent, or coloured as
the backdrop, still has edges and a shadow."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_CHANNELS_OF_COLOR_TYPE = {0: 1, 2: 3, 4: 2, 6: 4}
_BT709_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class PictureStatistics:
    """Statistics of a picture.

    Attributes:
        mean_luminance: BT.709 weights on display values from 0 to 1 [-].
        white_share: of the pixels whose least channel is at `WHITE_LEVEL` or above [-].
    """

    mean_luminance: float
    white_share: float


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
    return _rgb8(read_picture(path))


def read_image(path: Path, largest_width: int, *, reducing_gap: float | None = None) -> Image.Image:
    """A picture as 8 bits a channel, made smaller where it is wider; see `Image.resize`."""
    image = Image.fromarray(read_rgb8(path))
    if image.width > largest_width:
        height = max(1, round(image.height * largest_width / image.width))
        image = image.resize((largest_width, height), Image.Resampling.LANCZOS, reducing_gap=reducing_gap)
    return image


def read_rgb16(path: Path) -> NDArray[np.uint16]:
    """Pixels as (height, width, 3) uint16; 8-bit channels are spread over the range, alpha is laid over black."""
    color = _rgb(read_picture(path))
    if color.dtype == np.uint8:
        color = color.astype(np.uint16) * np.uint16(257)
    return np.ascontiguousarray(color, np.uint16)


def over_black(pixels: Pixels) -> NDArray[np.uint8]:
    """Decoded pixels over black and their alpha: (height, width, 4) uint8; alpha is 255 where there is none.

    A dark body before nothing differs from nothing by its alpha alone.
    """
    alpha = np.full(pixels.shape[:2], 255, np.uint8)
    if pixels.shape[2] in (2, 4):
        alpha = (pixels[..., -1] >> (8 * (pixels.dtype.itemsize - 1))).astype(np.uint8)
    return np.dstack([_rgb8(pixels), alpha])


def _rgb8(pixels: Pixels) -> NDArray[np.uint8]:
    color = _rgb(pixels)
    if color.dtype == np.uint16:
        color = ((color.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return np.ascontiguousarray(color, np.uint8)


def _rgb(pixels: Pixels) -> Pixels:
    """Colours of a picture, (height, width, 3), grey ones as well; what has alpha is laid over black."""
    channels, full = pixels.shape[2], np.iinfo(pixels.dtype).max
    color: Pixels = np.repeat(pixels[..., :1], 3, axis=2) if channels <= 2 else pixels[..., :3]
    if channels in (2, 4):
        shaded = (color.astype(np.uint32) * pixels[..., -1:] + full // 2) // full
        color = shaded.astype(np.uint8) if full == 255 else shaded.astype(np.uint16)
    return color


def check_pixels(
    path: Path, pixels: Pixels, resolution: tuple[int, int], *, may_be_empty: bool = False
) -> PictureStatistics:
    """Check that a rendered picture shows something.

    Args:
        path: the picture, for messages.
        pixels: its pixels as `read_picture` gives them.
        resolution: expected width and height [pixels].
        may_be_empty: whether nothing is left of it where no body is, so that it may be black or of one colour.

    Raises:
        InvalidFileError: it is of another size, black, or of one colour only.
    """
    height, width, channels = pixels.shape
    _require_size(path, (width, height), resolution)
    scale = float(np.iinfo(pixels.dtype).max)
    luminance = pixels[..., :3] @ _BT709_WEIGHTS / scale if channels >= 3 else pixels[..., 0] / scale
    color = pixels[..., :3] if channels >= 3 else pixels[..., :1]
    statistics = PictureStatistics(
        mean_luminance=float(luminance.mean()),
        white_share=float((color.min(axis=2) >= WHITE_LEVEL * scale).mean()),
    )
    if may_be_empty:
        return statistics
    if statistics.mean_luminance < BLACK_LUMINANCE:
        raise InvalidFileError(path, f"is black (mean luminance {statistics.mean_luminance:.2g})")
    spread = np.ptp(color.reshape(-1, color.shape[2]).astype(np.int64), axis=0).max()
    if spread <= FLAT_LEVELS * scale / 255.0:
        raise InvalidFileError(path, f"has one colour only: {color[0, 0].tolist()}")
    return statistics


def require_more_than_set(
    path: Path, shown: NDArray[np.uint8], empty: NDArray[np.uint8], cells: NDArray[np.bool_]
) -> None:
    """Refuse a picture that shows nothing but the empty set where bodies should be.

    Args:
        path: the picture.
        shown: its pixels as `over_black` gives them, (height, width, 4).
        empty: the same view without the bodies, a pixel for each of the cells, (rows, columns, 4), also `over_black`.
        cells: where bodies are, (rows, columns); some of them.

    Raises:
        InvalidFileError: nearly all of these cells look as they do without the bodies.
    """
    rows, columns = cells.shape
    small = Image.fromarray(shown).resize((columns, rows), Image.Resampling.BOX)
    difference = np.abs(np.asarray(small, np.int16) - empty.astype(np.int16)).max(axis=2)
    if (difference[cells] >= VISIBLE_LEVELS).mean() < SHARE_THAT_SHOWS:
        raise InvalidFileError(
            path, f"shows the empty set, though bodies are in {100 * cells.mean():.0f} % of it: they were not drawn"
        )


def validate_exr(path: Path, resolution: tuple[int, int], *, layer: str = "", may_be_empty: bool = False) -> None:
    """Decode an EXR and check that it shows something. All layers of a part are compressed together, so all are read.

    Args:
        path: an EXR in one part.
        resolution: expected width and height [pixels].
        layer: the layer that is the picture; empty where there is nothing else.
        may_be_empty: as for `check_pixels`.

    Raises:
        InvalidFileError: it is damaged, of another size, black, or has values that are not finite.
        OSError: it cannot be read.
    """
    from blender_scripts.exr import require_whole

    content = path.read_bytes()
    with invalid_if_refused(path):
        require_whole(content)  # FFmpeg leaves out what it cannot decode
    frame = _decoded(path, content, "exr", {"layer": layer} if layer else {})
    _require_size(path, (frame.width, frame.height), resolution)
    planes = [
        np.frombuffer(memoryview(plane), np.float16 if "f16" in frame.format.name else np.float32)
        .reshape(frame.height, -1)[:, : frame.width]
        .astype(np.float32)
        for plane in list(frame.planes)[:3]
    ]
    if not all(np.isfinite(plane).all() for plane in planes):
        raise InvalidFileError(path, "has values that are not finite")
    brightest = max(float(plane.max()) for plane in planes)
    if brightest < BLACK_LUMINANCE and not may_be_empty:
        raise InvalidFileError(path, f"is black (brightest value {brightest:.2g})")


def _require_size(path: Path, size: tuple[int, int], asked_for: tuple[int, int]) -> None:
    if size != tuple(asked_for):
        raise InvalidFileError(path, f"is {size[0]}x{size[1]} pixels, but {asked_for[0]}x{asked_for[1]} were asked for")


def _read_16_bit(path: Path, content: bytes, channels: int) -> NDArray[np.uint16]:
    """Pillow keeps 8 bits of a 16-bit picture; FFmpeg keeps all."""
    frame = _decoded(path, content, "png", {})
    layout = {1: "gray16be", 2: "ya16be", 3: "rgb48be", 4: "rgba64be"}[channels]
    if frame.format.name != layout:
        raise InvalidFileError(path, f"cannot be decoded as {layout} pixels")
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), ">u2").reshape(frame.height, plane.line_size // 2)
    return rows[:, : frame.width * channels].reshape(frame.height, frame.width, channels).astype(np.uint16)


def _decoded(path: Path, content: bytes, codec: str, options: dict[str, str]) -> Any:
    """The one frame that FFmpeg finds in a picture."""
    import av

    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.options = options
    try:
        frames = [*decoder.decode(av.Packet(content)), *decoder.decode(None)]
    except av.FFmpegError as error:
        raise InvalidFileError(path, f"cannot be decoded: {error}") from error
    if len(frames) != 1:
        raise InvalidFileError(path, "is not one picture")
    return frames[0]
