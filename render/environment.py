"""Pictures of the whole sphere around a scene (HDRIs): whether one can be read, without Blender."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from render.errors import InvalidFileError

SUFFIXES = (".hdr", ".exr")  # formats whose pixels are radiances: a PNG or JPEG of a sky has no sun

_HEADER_BYTES = 1 << 16
"""The headers of such pictures have some hundred bytes; of a longer one the size is not looked for further on."""
_EXR_WINDOW = b"dataWindow\0box2i\0"


def environment_pixels(path: Path) -> int | None:
    """Number of pixels of a picture, by its header alone; None where that does not say.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    if path.suffix.lower() == ".hdr":
        found = re.search(rb"^[-+][XY] (\d+) [-+][XY] (\d+)$", header, re.MULTILINE)
        return int(found[1]) * int(found[2]) if found else None
    start = header.find(_EXR_WINDOW) + len(_EXR_WINDOW) + 4  # behind the size of the attribute
    if _EXR_WINDOW not in header or len(header) < start + 16:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", header, start)
    return int(max(0, right - left + 1) * max(0, bottom - top + 1))


def read_environment_size(path: Path) -> tuple[int, int]:
    """Decode the picture; its width and height [pixels].

    Raises:
        InvalidFileError: it is of another format, or damaged.
        OSError: it cannot be read.
    """
    import av

    if path.suffix.lower() not in SUFFIXES:
        raise InvalidFileError(path, f"is no {' or '.join(SUFFIXES)} picture")
    try:
        # Through an open file, as a path would be taken apart for patterns of numbered pictures.
        # Of the format that the name says: FFmpeg would take anything else as well, even a list of other files.
        reader = f"{path.suffix.lower()[1:]}_pipe"
        with path.open("rb") as file, av.open(file, "r", format=reader) as container:
            frame = next(container.decode(video=0), None)
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise InvalidFileError(path, f"cannot be decoded: {error}") from error
    if frame is None:
        raise InvalidFileError(path, "holds no picture")
    return frame.width, frame.height
