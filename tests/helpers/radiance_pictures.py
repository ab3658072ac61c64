"""Small Radiance pictures (.hdr), as cameras and panoramas are stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike


def write_hdr(path: Path, radiance: ArrayLike) -> bytes:
    """Write linear RGB, (rows, columns, 3) from the top, without compression; returns the file's content."""
    values = np.asarray(radiance, dtype=np.float64)
    rows, columns, _ = values.shape
    mantissa, exponent = np.frexp(np.maximum(values.max(axis=2), 1e-30))
    scale = 256.0 * mantissa / np.maximum(values.max(axis=2), 1e-30)
    pixels = np.empty((rows, columns, 4), np.uint8)
    pixels[..., :3] = np.clip(values * scale[..., None], 0, 255)
    pixels[..., 3] = exponent + 128
    content = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {rows} +X {columns}\n".encode() + pixels.tobytes()
    path.write_bytes(content)
    return content
