"""Pictures of the whole sphere around a scene (HDRIs): whether one can be read, without Blender."""

from __future__ import annotations

from pathlib import Path

from render.errors import InvalidFileError

SUFFIXES = (".hdr", ".exr")
"""Formats whose pixels are radiances: a PNG or JPEG of a sky has no sun."""


def read_environment_size(path: Path) -> tuple[int, int]:
    """Decode the picture.

    Returns:
        Width and height [pixels].

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
