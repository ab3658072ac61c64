"""Pictures with an alpha channel, laid over an even colour."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from blender_scripts import png


def lay_over(path: Path, color: tuple[float, float, float]) -> None:
    """Replace a picture with 8 bits of alpha by one without, over a colour as it is, linear RGB.

    It is laid over what the screen shows: were the colour in the scene, the view transform would make another of it.
    """
    image = bpy.data.images.load(str(path.resolve()))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "STRAIGHT"
        columns, rows = image.size
        pixels = np.empty(rows * columns * 4, dtype=np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    upright = pixels.reshape(rows, columns, 4)[::-1]
    alpha = upright[..., 3:]
    flat = alpha * upright[..., :3] + (1.0 - alpha) * np.array([_encoded(channel) for channel in color])
    png.write_rgb8(path, np.rint(255.0 * flat).astype(np.uint8))


def _encoded(linear: float) -> float:
    """sRGB's value of a linear one."""
    return float(12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)
