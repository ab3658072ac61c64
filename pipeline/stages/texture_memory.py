"""Memory that a job's own pictures, an HDRI, a backplate and those packed into .blend files, take in each renderer.

Measured with bpy 5.0.1 as the growth of the largest resident memory: 16 to 25 bytes a pixel of an HDRI, with the map
of where light comes from; of textures in a .blend file, 9.7 bytes a pixel of bytes and 42 of floats. Blender and Cycles
hold a picture each, and for a while the file as it was read. A backplate is let go once it has the size of the frames:
16 bytes a pixel if it has 16 bits, and its file.
"""

from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from math import prod
from pathlib import Path

from pipeline.base.files import replacing
from pipeline.base.parameter_set import digest_of
from pipeline.job.input_files import split_blend
from pipeline.store.receipts import hash_file
from render.backplate import backplate_size
from render.blend_file import Texture, read_textures
from render.blender import BlenderUnavailableError
from render.environment import environment_pixels
from render.errors import InvalidFileError
from render.spec import RenderSpec
from sim.core.runtime import cache_folder

BYTES_PER_HDRI_PIXEL = 25
BYTES_PER_BACKPLATE_PIXEL = 20
LIGHT_MAP_BYTES = 8 * 1024 * 512
BYTES_PER_TEXTURE_PIXEL, BYTES_PER_FLOAT_TEXTURE_PIXEL = 11, 42


def own_picture_bytes(spec: RenderSpec) -> int:
    """Memory of a renderer for them [bytes]. Each body has a material of its own, and so pictures of its own.

    What cannot be read counts for nothing here: the checks of a job and the preflight of its stages report it.
    """
    total = 0
    if spec.set.hdri is not None:
        with suppress(OSError):
            total += BYTES_PER_HDRI_PIXEL * (environment_pixels(Path(spec.set.hdri)) or 0) + LIGHT_MAP_BYTES
    if spec.set.backplate is not None:
        with suppress(OSError, InvalidFileError):
            total += BYTES_PER_BACKPLATE_PIXEL * prod(backplate_size(Path(spec.set.backplate)))
    for drawn in spec.objects:
        if drawn.material.blend is not None:
            file, name = split_blend(drawn.material.blend)
            with suppress(OSError):
                status = Path(file).stat()
                total += _texture_bytes(file, name, spec.render.blender, status.st_size, status.st_mtime_ns)
    return total


def bytes_of_textures(textures: Iterable[Texture]) -> int:
    """Memory of textures in a renderer [bytes]. Pure."""
    return sum(
        each.width * each.height * (BYTES_PER_FLOAT_TEXTURE_PIXEL if each.floats else BYTES_PER_TEXTURE_PIXEL)
        for each in textures
    )


@lru_cache
def _texture_bytes(file: str, name: str, blender: str | None, _size: int, _mtime_ns: int) -> int:
    """Asked of Blender, in a child process, once for a content: the answer is kept in the user's cache folder."""
    kept = cache_folder() / "blend-textures" / digest_of(f"{hash_file(Path(file))}\n{name}")
    with suppress(OSError, ValueError):
        return int(kept.read_text(encoding="ascii"))
    try:
        size = bytes_of_textures(read_textures(Path(file), name, blender))
    except (BlenderUnavailableError, InvalidFileError):
        return 0
    with suppress(OSError), replacing(kept) as part:
        part.write_text(str(size), encoding="ascii")
    return size
