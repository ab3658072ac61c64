"""OpenEXR files whose bytes depend on the picture alone. Layout: "OpenEXR File Layout", openexr.com.

magic, version and flags | headers: attributes (name, type, size, value) | tables of chunk offsets | chunks
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

_MAGIC = b"\x76\x2f\x31\x01"
_MULTI_PART = 0x1000
_ZIP = frozenset({b"\x02", b"\x03"})  # values of `compression`: zlib by line, and by 16 lines
# Blender stamps when and where it drew, and Cycles how long that took.
_VARYING = re.compile(rb"Date|Time|RenderTime|File|Hostname|Memory|cycles\..*_time")


@dataclass(frozen=True)
class Attribute:
    """An attribute of a header: its name, the name of its type, and its bytes."""

    name: bytes
    kind: bytes
    value: bytes

    def packed(self) -> bytes:
        """As in the file."""
        return self.name + b"\0" + self.kind + b"\0" + struct.pack("<i", len(self.value)) + self.value


@dataclass(frozen=True)
class ExrLayout:
    """What comes before the pixels.

    That is version and flags, attributes of each part, where the tables of chunk offsets begin, and where chunks do.
    """

    version: int
    parts: tuple[tuple[Attribute, ...], ...]
    tables_at: int
    offsets: tuple[int, ...]


def read_layout(content: bytes) -> ExrLayout:
    """Headers and chunk offsets of an EXR file's content.

    Raises:
        ValueError: it is not an EXR file, or it is truncated.
    """
    if content[:4] != _MAGIC:
        raise ValueError("not an EXR file")
    try:
        (version,) = struct.unpack_from("<I", content, 4)
        position, parts = 8, []
        while True:
            attributes, position = _read_header(content, position)
            if not attributes:
                break
            parts.append(attributes)
            if not version & _MULTI_PART:
                break
        # The first chunk in the file follows the tables.
        (first,) = struct.unpack_from("<Q", content, position)
        offsets = struct.unpack_from(f"<{(first - position) // 8}Q", content, position)
    except (struct.error, ValueError) as error:
        raise ValueError("truncated EXR file") from error
    if not parts or min(offsets, default=0) != position + 8 * len(offsets) or max(offsets) >= len(content):
        raise ValueError("truncated EXR file, or its chunks are not where it says")
    return ExrLayout(version, tuple(parts), position, offsets)


def require_whole(content: bytes) -> None:
    """Make sure that an EXR of scan lines holds all its chunks, and that those packed by ZIP can be unpacked.

    Raises:
        ValueError: it is not an EXR file, or it is damaged.
    """
    layout = read_layout(content)
    part_number = 4 if layout.version & _MULTI_PART else 0
    packings = {attribute.value for part in layout.parts for attribute in part if attribute.name == b"compression"}
    chunks = sorted(layout.offsets)
    for start, end in zip(chunks, [*chunks[1:], len(content)], strict=True):
        data = start + part_number + 8  # after the part's number, the first line's and the size
        if data > end or data + struct.unpack_from("<i", content, data - 4)[0] != end:
            raise ValueError("truncated EXR file")
        if packings <= _ZIP and not _unpacks(content[data:end]):
            raise ValueError("damaged EXR file")


def _unpacks(data: bytes) -> bool:
    """Whether a chunk is sound by its own checksum; one that would not shrink is stored as it is, without any."""
    try:
        zlib.decompress(data)
    except zlib.error:
        return data[:1] != b"\x78"
    return True


def strip_metadata(path: Path) -> None:
    """Remove the attributes that vary from run to run, in place."""
    content = path.read_bytes()
    layout = read_layout(content)
    header = content[:8]
    for attributes in layout.parts:
        kept = [each for each in attributes if not _VARYING.fullmatch(each.name)]
        header += b"".join(each.packed() for each in kept) + b"\0"
    if layout.version & _MULTI_PART:
        header += b"\0"
    shift = layout.tables_at - len(header)
    tables = struct.pack(f"<{len(layout.offsets)}Q", *(offset - shift for offset in layout.offsets))
    path.write_bytes(header + tables + content[min(layout.offsets) :])


def _read_header(content: bytes, position: int) -> tuple[tuple[Attribute, ...], int]:
    """Attributes up to the empty name that ends them, and where it goes on."""
    attributes = []
    while content[position : position + 1] != b"\0":
        name, position = _read_text(content, position)
        kind, position = _read_text(content, position)
        (size,) = struct.unpack_from("<i", content, position)
        position += 4
        if size < 0 or position + size > len(content):
            raise ValueError("truncated EXR file")
        attributes.append(Attribute(name, kind, content[position : position + size]))
        position += size
    return tuple(attributes), position + 1


def _read_text(content: bytes, position: int) -> tuple[bytes, int]:
    end = content.index(b"\0", position)
    return content[position:end], end + 1
