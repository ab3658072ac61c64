"""VTK's XML files, as ParaView opens them: meshes and points (.vtp), grids (.vti), a frame (.vtm), a series (.pvd).

Arrays are appended as they are in memory, each compressed with zlib in blocks of 1 MiB. An array's unit is the key
UNITS_LABEL of its information, which VTK's readers keep. The same arrays give the same bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import InvalidFileError, invalid_if_refused

_TYPES = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}
_DTYPES = {name: np.dtype(f"<{code}") for code, name in _TYPES.items()}
_BLOCK = 1 << 20
_LEVEL = 1
_APPENDED = b'<AppendedData encoding="raw">\n_'
_END = b"\n</AppendedData>\n</VTKFile>\n"


@dataclass(frozen=True)
class Values:
    """An array of an element a row, (n,) or (n, 3), and its unit; "1" for plain numbers."""

    array: ArrayLike
    unit: str


def write_polydata(
    path: Path,
    points: ArrayLike,
    *,
    triangles: ArrayLike | None = None,
    point_values: Mapping[str, Values],
    cell_values: Mapping[str, Values] | None = None,
    time_s: float,
) -> None:
    """Write a mesh of triangles, or a cloud of points where there are none. Nothing at all is legal.

    Args:
        path: the file to write.
        points: positions [m], (n, 3).
        triangles: indices of points, (m, 3); None: every point is a cell of its own.
        point_values: by name, a row for each point.
        cell_values: by name, a row for each triangle or point.
        time_s: simulated time [s].
    """
    file = _Appended()
    position = np.asarray(points, np.float32).reshape(-1, 3)
    of_points = "".join(file.add(name, each) for name, each in point_values.items())
    of_cells = "".join(file.add(name, each) for name, each in (cell_values or {}).items())
    cells = np.arange(len(position)).reshape(-1, 1) if triangles is None else np.asarray(triangles).reshape(-1, 3)
    ends = np.arange(1, len(cells) + 1, dtype=np.int64) * cells.shape[1]
    topology = file.add("connectivity", Values(cells.astype(np.int64).ravel(), "")) + file.add(
        "offsets", Values(ends, "")
    )
    kind = "Verts" if triangles is None else "Polys"
    counts = {"Verts": 0, "Lines": 0, "Strips": 0, "Polys": 0, kind: len(cells)}
    numbers = " ".join(f'NumberOf{name}="{count}"' for name, count in counts.items())
    body = (
        f'<PolyData>\n{_time(file, time_s)}<Piece NumberOfPoints="{len(position)}" {numbers}>\n'
        f"<PointData>\n{of_points}</PointData>\n<CellData>\n{of_cells}</CellData>\n"
        f"<Points>\n{file.add('position', Values(position, 'm'))}</Points>\n"
        f"<{kind}>\n{topology}</{kind}>\n</Piece>\n</PolyData>\n"
    )
    file.write(path, "PolyData", body)


def write_grid(
    path: Path,
    cell_values: Mapping[str, Values],
    *,
    first_cell: Sequence[int],
    origin: Sequence[float],
    cell_size: float,
    time_s: float,
) -> None:
    """Write values in the cells of a grid of cubes.

    Args:
        path: the file to write.
        cell_values: by name, (nx, ny, nz) or (nx, ny, nz, 3).
        first_cell: of the whole grid, where the arrays begin.
        origin: lower corner of the whole grid [m].
        cell_size: [m].
        time_s: simulated time [s].
    """
    file = _Appended()
    shape = np.shape(next(iter(cell_values.values())).array)[:3]
    extent = " ".join(f"{low} {low + n}" for low, n in zip(first_cell, shape, strict=True))

    def in_order(values: Values) -> Values:
        """VTK's x runs fastest."""
        array = np.asarray(values.array)
        axes = (2, 1, 0, *range(3, array.ndim))
        return Values(np.ascontiguousarray(array.transpose(axes)).reshape(-1, *array.shape[3:]), values.unit)

    of_cells = "".join(file.add(name, in_order(each)) for name, each in cell_values.items())
    corner = " ".join(repr(float(x)) for x in origin)
    spacing = " ".join([repr(float(cell_size))] * 3)
    body = (
        f'<ImageData WholeExtent="{extent}" Origin="{corner}" Spacing="{spacing}">\n{_time(file, time_s)}'
        f'<Piece Extent="{extent}">\n<PointData/>\n<CellData>\n{of_cells}</CellData>\n</Piece>\n</ImageData>\n'
    )
    file.write(path, "ImageData", body)


def write_blocks(path: Path, blocks: Iterable[tuple[str, str]]) -> None:
    """Write the named parts of a frame: names, and files relative to this one."""
    rows = "".join(
        f"<DataSet index={quoteattr(str(index))} name={quoteattr(name)} file={quoteattr(file)}/>\n"
        for index, (name, file) in enumerate(blocks)
    )
    path.write_text(
        f'<VTKFile type="vtkMultiBlockDataSet" version="1.0" byte_order="LittleEndian">\n<vtkMultiBlockDataSet>\n{rows}'
        "</vtkMultiBlockDataSet>\n</VTKFile>\n",
        encoding="utf-8",
    )


def write_series(path: Path, frames: Iterable[tuple[float, str]]) -> None:
    """Write what ParaView plays as one series: simulated times [s], and files relative to this one."""
    rows = "".join(
        f'<DataSet timestep="{time_s!r}" group="" part="0" file={quoteattr(file)}/>\n' for time_s, file in frames
    )
    path.write_text(
        f'<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">\n<Collection>\n{rows}'
        "</Collection>\n</VTKFile>\n",
        encoding="utf-8",
    )


def validate_vtk(path: Path) -> None:
    """Decode a file of this module: its XML, and every appended array, of numbers that are finite.

    Raises:
        InvalidFileError: it is damaged.
        OSError: it cannot be read.
    """
    with invalid_if_refused(path):
        for name, array in _read_arrays(path.read_bytes()).items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise InvalidFileError(path, f"{name} holds values that are not finite")


def _read_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """Appended arrays of a file by name. Raises ValueError: it is damaged."""
    head, appended, tail = content.partition(_APPENDED)
    try:
        root = ElementTree.fromstring(head + b"</VTKFile>" if appended else content)  # noqa: S314 - our own file
    except ElementTree.ParseError as error:
        raise ValueError(f"is not XML: {error}") from error
    if not appended:
        return {}
    if not tail.endswith(_END):
        raise ValueError("was truncated")
    found = {}
    for each in root.iter("DataArray"):
        start = int(each.attrib["offset"])
        blocks, size, last = (int(n) for n in np.frombuffer(tail, "<u8", 3, start))
        packed = np.frombuffer(tail, "<u8", blocks, start + 24)
        place, parts = start + 24 + 8 * blocks, []
        for length in map(int, packed):
            try:
                parts.append(zlib.decompress(tail[place : place + length]))
            except zlib.error as error:
                raise ValueError(f"{each.attrib['Name']} is damaged: {error}") from error
            place += length
        data = b"".join(parts)
        if blocks and len(data) != (blocks - 1) * size + (last or size):
            raise ValueError(f"{each.attrib['Name']} has {len(data)} bytes, which is not what was promised")
        found[each.attrib["Name"]] = np.frombuffer(data, _DTYPES[each.attrib["type"]])
    return found


def _time(file: _Appended, time_s: float) -> str:
    """Field data that readers take the time from."""
    return f"<FieldData>\n{file.add('TimeValue', Values(np.array([time_s]), 's'), tuples=1)}</FieldData>\n"


class _Appended:
    """The arrays of a file, behind its XML."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: Values, *, tuples: int | None = None) -> str:
        """Take an array in; returns the element that describes it."""
        array = np.ascontiguousarray(values.array)
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        width = 1 if array.ndim == 1 else array.shape[1]
        count = "" if tuples is None else f' NumberOfTuples="{tuples}"'
        unit = ""
        if values.unit:
            key = f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{values.unit}</InformationKey>'
            unit = f"{key}\n"
        kind = _TYPES[array.dtype.str[1:]]
        element = (
            f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{width}"{count}'
            f' format="appended" offset="{self._size}">\n{unit}</DataArray>\n'
        )
        data = array.tobytes()
        packed = [zlib.compress(data[start : start + _BLOCK], _LEVEL) for start in range(0, len(data), _BLOCK)]
        sizes = [len(packed), _BLOCK, len(data) % _BLOCK, *map(len, packed)]
        self._parts += [np.array(sizes, "<u8").tobytes(), *packed]
        self._size += 8 * len(sizes) + sum(map(len, packed))
        return element

    def write(self, path: Path, kind: str, body: str) -> None:
        """Write the file."""
        opening = (
            f'<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
            'compressor="vtkZLibDataCompressor">\n'
        )
        with path.open("wb") as file:
            file.write((opening + body).encode())
            file.write(_APPENDED)
            file.writelines(self._parts)
            file.write(_END)
