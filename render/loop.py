"""Short films for web pages and READMEs: animated WebP and GIF that start again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from render.pictures import read_image

FORMATS = (".webp", ".gif")
_GIF_TICK_MS = 10  # a GIF counts time in hundredths of a second, and browsers show less than two of them as ten
_LARGEST_GIF_FPS = 50.0
_WEBP_QUALITY = 80


def write_loop(pictures: Sequence[Path], output: Path, *, fps: float, width: int, loop_fps: float) -> int:
    """Write a film that starts again, .webp or .gif, and return the number of its frames.

    Args:
        pictures: PNG files, `fps` a second; they are never enlarged.
        output: the file to write.
        width: of the loop at most [pixels].
        loop_fps: frames a second of the loop [1/s]; no more than there are pictures for.

    Raises:
        InvalidFileError: a picture is damaged.
        ValueError: there are no pictures, or of several sizes, or a GIF is to be faster than it can be.
        OSError: it cannot be written.
    """
    suffix = output.suffix.lower()
    if not pictures:
        raise ValueError("a loop needs at least one picture")
    loop_fps = min(loop_fps, fps)
    if suffix == ".gif" and loop_fps > _LARGEST_GIF_FPS:
        raise ValueError(f"a GIF has at most {_LARGEST_GIF_FPS:g} frames a second, not {loop_fps:g}")
    count = max(1, round(len(pictures) / fps * loop_fps))
    chosen = [pictures[min(int(number * fps / loop_fps + 1e-6), len(pictures) - 1)] for number in range(count)]
    frames = [read_image(path, width) for path in chosen]
    for path, frame in zip(chosen, frames, strict=True):
        if frame.size != frames[0].size:
            raise ValueError(f"{path} is of another size than {chosen[0]}")
    tick = _GIF_TICK_MS if suffix == ".gif" else 1
    ends = [tick * round(1000.0 * (number + 1) / loop_fps / tick) for number in range(count)]
    durations = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    options = {"quality": _WEBP_QUALITY, "method": 5} if suffix == ".webp" else {"optimize": True}
    if suffix == ".gif":
        # One palette for all: with one a frame, still backgrounds would flicker.
        palette = _palette_of(frames)
        frames = [frame.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for frame in frames]
    try:
        frames[0].save(
            output,
            format=suffix[1:],
            save_all=True,
            append_images=frames[1:],
            duration=durations,
            loop=0,
            **options,
        )
    except RuntimeError as error:  # what Pillow raises where libwebp refuses
        raise ValueError(f"the pictures do not make a loop: {error}") from error
    return count


def _palette_of(frames: Sequence[Image.Image]) -> Image.Image:
    """256 colours for all frames, from a strip of some of them."""
    chosen = frames[:: max(1, len(frames) // 12)]
    strip = Image.new("RGB", (frames[0].width, frames[0].height * len(chosen)))
    for row, frame in enumerate(chosen):
        strip.paste(frame, (0, row * frames[0].height))
    return strip.quantize(256, method=Image.Quantize.MAXCOVERAGE)
