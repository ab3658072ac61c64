"""OpenVDB files made reproducible, and checked to be whole, neither of which the library does.

The library puts a random identifier into each header, ignores a full disk while it writes, and reads many a damaged
file without complaint. Here the identifier is derived from the content, so that equal volumes are equal bytes and a
changed byte shows, and the size of a new file is compared with the one that its header promises.

Layout of a file (OpenVDB 12, `openvdb/io/Archive.cc` and `GridDescriptor.cc`), little endian: magic number, file
version, library major and minor version, a flag for grid offsets, the identifier (36 characters), metadata, number of
grids; then of each grid its name, type, instance parent, where its metadata, its values and its end are in the file,
and the grid itself. A string is its length and its bytes.
"""

from __future__ import annotations

import errno
import os
import re
import struct
import uuid
from pathlib import Path

from blake3 import blake3

from render.errors import InvalidFileError

_MAGIC = b" BDV\x00\x00\x00\x00"
_UUID = slice(21, 57)
_UUID_PATTERN = re.compile(rb"[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}")

_RETRY_BYTES = 1 << 20


def sign(path: Path) -> None:
    """Check that a new file is whole, and replace its random identifier by one that follows from the content.

    Raises:
        OSError: the disk was full, or refused to write for another reason.
        InvalidFileError: it is not an OpenVDB file at all.
    """
    with path.open("r+b") as file:
        content = file.read()
        _check_header(path, content)
        promised = _promised_size(content)
        if promised is None or promised > len(content):
            # The library has swallowed the reason; writing on makes the system state it again.
            file.write(bytes(_RETRY_BYTES))
            file.flush()
            os.fsync(file.fileno())
            raise OSError(errno.EIO, "OpenVDB could not write the whole file", str(path))
        file.seek(_UUID.start)
        file.write(_identifier(content))


def check(path: Path) -> None:
    """Check that a file is as `sign` left it.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    _check_header(path, content)
    if content[_UUID] != _identifier(content):
        raise InvalidFileError(path, "was truncated or changed since it was written")


def _check_header(path: Path, content: bytes) -> None:
    if content[: len(_MAGIC)] != _MAGIC or not _UUID_PATTERN.fullmatch(content[_UUID]):
        raise InvalidFileError(path, "is not an OpenVDB file")


def _identifier(content: bytes) -> bytes:
    view = memoryview(content)
    digest = blake3(view[: _UUID.start]).update(view[_UUID.stop :])
    return str(uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest())).encode("ascii")


class _Reader:
    """Walks through a header; `struct.error` tells that the file ends before it does."""

    def __init__(self, content: bytes, position: int) -> None:
        self.content, self.position = content, position

    def number(self, layout: str) -> int:
        (value,) = struct.unpack_from(layout, self.content, self.position)
        self.position += struct.calcsize(layout)
        return int(value)

    def skip_three_strings(self) -> None:
        for _ in range(3):
            size = self.number("<I")
            self.position += size


def _promised_size(content: bytes) -> int | None:
    """Where the last grid ends, or None where the file is cut before it says so."""
    reader = _Reader(content, _UUID.stop)
    try:
        for _ in range(reader.number("<I")):  # metadata of the file: name, type, value
            reader.skip_three_strings()
        for _ in range(reader.number("<I")):  # grids: name, type, instance parent
            reader.skip_three_strings()
            grid_start, values_start, end = (reader.number("<q") for _ in range(3))
            if not reader.position <= grid_start <= values_start <= end:
                return None  # they are filled in last
            reader.position = end
    except struct.error:
        return None
    return reader.position
