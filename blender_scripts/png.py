"""PNG files whose bytes depend on the picture alone."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Blender stamps date and render time into text chunks; none of these kinds says anything about the pixels.
_VARYING_CHUNKS = frozenset({b"tEXt", b"zTXt", b"iTXt", b"tIME", b"eXIf"})


def iterate_chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield (type, whole chunk including length and checksum) of a PNG file's content.

    Raises:
        ValueError: it is not a PNG file, or it is truncated.
    """
    if not content.startswith(_SIGNATURE):
        raise ValueError("not a PNG file")
    offset, kind = len(_SIGNATURE), b""
    while offset < len(content):
        if offset + 12 > len(content):
            raise ValueError("truncated PNG file")
        length, kind = struct.unpack_from(">I4s", content, offset)
        end = offset + 12 + length
        if end > len(content):
            raise ValueError("truncated PNG file")
        yield kind, content[offset:end]
        offset = end
    if kind != b"IEND":
        raise ValueError("truncated PNG file")


def strip_metadata(path: Path) -> None:
    """Remove the chunks that vary from run to run, in place."""
    content = path.read_bytes()
    kept = [chunk for kind, chunk in iterate_chunks(content) if kind not in _VARYING_CHUNKS]
    stripped = _SIGNATURE + b"".join(kept)
    if len(stripped) != len(content):
        path.write_bytes(stripped)


def write_rgb8(path: Path, pixels: np.ndarray) -> None:
    """Write pixels, (rows, columns, 3) uint8 from the top."""
    rows, columns, _ = pixels.shape
    # What differs from the row above compresses better: filter 2, "up".
    above = np.vstack([np.zeros((1, columns, 3), np.uint8), pixels[:-1]])
    lines = np.hstack([np.full((rows, 1), 2, np.uint8), (pixels - above).reshape(rows, -1)])
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines.tobytes(), 6)),
        (b"IEND", b""),
    )
    path.write_bytes(
        _SIGNATURE
        + b"".join(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in chunks
        )
    )
