"""Pictures with an alpha channel, laid over an even colour or another picture.

They are laid over what the screen shows: were colour or picture in the scene, the view transform would change them.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from blender_scripts import png
from blender_scripts.errors import RenderInputError


class EvenColor:
    """A colour behind pictures, linear RGB."""

    def __init__(self, color: tuple[float, float, float]) -> None:
        self._display = np.array([_encoded(channel) for channel in color], dtype=np.float32)

    def behind(self, rows: int, columns: int) -> np.ndarray:  # noqa: ARG002 - of any size
        """Display values that broadcast to (rows, columns, 3)."""
        return self._display


class Backplate:
    """A picture behind pictures: as large as fills them, its middle in theirs."""

    def __init__(self, path: Path) -> None:
        """Note where it is; it is read for each size that it is needed in.

        Raises:
            RenderInputError: it cannot be read.
        """
        self._path = path
        self._of_size: dict[tuple[int, int], np.ndarray] = {}
        self.behind(1, 1)

    def behind(self, rows: int, columns: int) -> np.ndarray:
        """Display values, (rows, columns, 3) from the top."""
        if (rows, columns) not in self._of_size:
            self._of_size[rows, columns] = self._read(rows, columns)
        return self._of_size[rows, columns]

    def _read(self, rows: int, columns: int) -> np.ndarray:
        try:
            image = bpy.data.images.load(str(self._path.resolve()))
        except RuntimeError as error:
            raise RenderInputError(f"cannot read the picture {self._path}: {error}") from error
        try:
            image.colorspace_settings.name = "Non-Color"
            image.alpha_mode = "NONE"
            width, height = image.size
            if not width or not height:
                raise RenderInputError(f"cannot read the picture {self._path}: Blender finds no pixels in it")
            scale = max(columns / width, rows / height)
            image.scale(max(columns, round(scale * width)), max(rows, round(scale * height)))
            pixels = _pixels_of(image)
        finally:
            bpy.data.images.remove(image)
        top, left = (pixels.shape[0] - rows) // 2, (pixels.shape[1] - columns) // 2
        return pixels[top : top + rows, left : left + columns, :3].copy()


def lay_over(path: Path, ground: EvenColor | Backplate) -> None:
    """Replace a picture with 8 bits of alpha by one without, over what is behind it."""
    image = bpy.data.images.load(str(path.resolve()))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "STRAIGHT"
        upright = _pixels_of(image)
    finally:
        bpy.data.images.remove(image)
    alpha = upright[..., 3:]
    flat = alpha * upright[..., :3] + (1.0 - alpha) * ground.behind(*upright.shape[:2])
    png.write_rgb8(path, np.rint(255.0 * flat).astype(np.uint8))


def _pixels_of(image: bpy.types.Image) -> np.ndarray:
    """Values of an image, (rows, columns, 4) from the top."""
    columns, rows = image.size
    pixels = np.empty(rows * columns * 4, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(rows, columns, 4)[::-1]


def _encoded(linear: float) -> float:
    """sRGB's value of a linear one."""
    return float(12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)
