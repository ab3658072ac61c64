"""Pictures behind a scene (backplates): whether one can be read as it is meant, without Blender."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from render.errors import InvalidFileError

FORMATS = ("JPEG", "PNG")
_ORIENTATION = 0x0112  # the EXIF tag that says how a camera was held
_MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I")


def backplate_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture by its header [pixels].

    Raises:
        InvalidFileError: it is no JPEG or PNG.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        try:
            with Image.open(file, formats=FORMATS) as image:
                return image.size
        except Image.DecompressionBombError as error:
            raise InvalidFileError(path, "has too many pixels; scale it down") from error
        except (OSError, ValueError, SyntaxError) as error:
            raise InvalidFileError(path, "is no JPEG or PNG picture") from error


def read_backplate_size(path: Path) -> tuple[int, int]:
    """Decode the picture; its width and height [pixels].

    Raises:
        InvalidFileError: it is no JPEG or PNG, or damaged, or not stored as it is seen.
        OSError: it cannot be read.
    """
    width, height = backplate_size(path)
    with path.open("rb") as file, Image.open(file, formats=FORMATS) as image:
        if image.mode not in _MODES:
            raise InvalidFileError(path, f"has {image.mode} colours; save it as RGB")
        if (turn := image.getexif().get(_ORIENTATION, 1)) != 1:
            raise InvalidFileError(path, f"is stored turned (EXIF orientation {turn}); save it upright")
        try:
            image.load()
        except (OSError, ValueError, SyntaxError) as error:
            raise InvalidFileError(path, f"cannot be decoded: {error}") from error
    return width, height
