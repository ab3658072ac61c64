"""Small versions of frames, made when they are asked for and kept in memory."""

import io
from pathlib import Path

from pipeline.web.bounded_cache import BoundedCache
from pipeline.web.dashboard.places import NotThereError

WIDTHS = {"small": 320, "large": 1600}
"""Largest widths of the versions [pixels]."""
KEPT_BYTES = 48 * 2**20
QUALITY = 80
MOST_PIXELS = 64 * 2**20
"""A larger picture is no frame of ours: 8K has 33 million pixels."""


class Thumbnails:
    """Small versions of frames. Safe to share between threads."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept: BoundedCache[tuple[Path, str], bytes] = BoundedCache(kept_bytes, len)

    @staticmethod
    def tag(path: Path, size: str) -> str:
        """Tag that changes with the picture. Raises NotThereError if it is gone."""
        try:
            status = path.stat()
        except OSError as error:
            raise NotThereError("this frame is gone") from error
        return f"{status.st_mtime_ns:x}-{status.st_size:x}-{size}"

    def get(self, path: Path, size: str) -> bytes:
        """The small version of a frame, a WebP picture. Raises NotThereError: it is gone, or no picture."""
        tag = self.tag(path, size)
        content = self._kept.get((path, size), tag)
        if content is None:
            content = _make(path, WIDTHS[size])
            self._kept.put((path, size), tag, content)
        return content


def _make(path: Path, width: int) -> bytes:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=["PNG"]) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                raise NotThereError(f"{path.name} is too large to be shown")
            small = picture.convert("RGBA" if "A" in picture.getbands() else "RGB")
        if small.width > width:
            height = max(1, round(small.height * width / small.width))
            small = small.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=2.0)
        written = io.BytesIO()
        small.save(written, "WEBP", quality=QUALITY, method=3)
    except Image.DecompressionBombError as error:
        raise NotThereError(f"{path.name} is too large to be shown") from error
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError) as error:  # SyntaxError: a broken chunk
        raise NotThereError(f"{path.name} is no picture") from error
    return written.getvalue()
