"""Small versions of frames, made when they are asked for and kept in memory."""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from pathlib import Path

from pipeline.dashboard.places import NotThereError

WIDTHS = {"small": 320, "large": 1600}
"""How wide the versions are at most [pixels]."""
KEPT_BYTES = 48 * 2**20
QUALITY = 80
MOST_PIXELS = 64 * 2**20
"""A larger picture is no frame of ours: 8K has 33 million pixels."""


class Thumbnails:
    """Makes small versions, and keeps the ones that were last asked for. Safe to share between threads."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept: OrderedDict[tuple[Path, str], bytes] = OrderedDict()
        self._bytes = 0
        self._kept_bytes = kept_bytes
        self._lock = threading.Lock()

    @staticmethod
    def tag(path: Path, size: str) -> str:
        """What changes with the picture. Raises NotThereError if it is gone."""
        try:
            status = path.stat()
        except OSError as error:
            raise NotThereError("this frame is gone") from error
        return f"{status.st_mtime_ns:x}-{status.st_size:x}-{size}"

    def get(self, path: Path, size: str) -> bytes:
        """The small version of a frame, a WebP picture.

        Args:
            path: a committed picture.
            size: one of WIDTHS.

        Raises:
            NotThereError: it is gone, or no picture.
        """
        key = (path, self.tag(path, size))
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        content = _make(path, WIDTHS[size])
        with self._lock:
            if key not in self._kept:
                self._kept[key] = content
                self._bytes += len(content)
            while self._bytes > self._kept_bytes and len(self._kept) > 1:
                _, dropped = self._kept.popitem(last=False)
                self._bytes -= len(dropped)
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
