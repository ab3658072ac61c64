"""Smoke volumes as OpenVDB files: `density`, `temperature` and `velocity` on one grid of cells.

Equal arrays give equal bytes, and a file that was changed is noticed (`vdb_file`). Layout: docs/guide/formats.md. Grids
are filled column by column: beside the arrays that are written only masks, and what OpenVDB makes of them, take memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blender_scripts import openvdb_binding
from render import vdb_file
from render.errors import InvalidFileError, VolumeUnavailableError
from render.parameters import VolumeParameters
from render.smoke_region import Box, blur_reach, bounding_box, grown

Float32Array = NDArray[np.float32]

GRID_TYPES = {"density": "float", "temperature": "float", "velocity": "vec3s"}
TEMPERATURE_TOLERANCE_K = 0.5
"""Air this close to the ambient temperature [K] is stored as ambient; it emits and lifts nothing visible."""

CREATOR = "physics-pipeline"
HALF_MAX = 65504.0  # largest number of 16 bits; OpenVDB would silently make infinity of a larger one

_SLAB = 32  # cells along x that are looked at together
_COLUMN = 32  # cells along x and y that are given to OpenVDB together; whole leaves of its tree, which are 8 wide


def import_openvdb() -> ModuleType:
    """The OpenVDB binding. Raises VolumeUnavailableError: there is none, or it cannot be loaded."""
    try:
        return openvdb_binding.import_openvdb()
    except RuntimeError as error:
        raise VolumeUnavailableError(str(error)) from error


def write_volume(
    path: Path,
    *,
    density: ArrayLike,
    temperature: ArrayLike,
    velocity: ArrayLike,
    origin: Sequence[float],
    cell_size: float,
    ambient_temperature: float,
    parameters: VolumeParameters,
    fps: float,
    shutter: float,
    first_cell: tuple[int, int, int] = (0, 0, 0),
) -> None:
    """Write one frame of smoke; the same arrays give the same bytes.

    The velocity is kept where there is smoke or heat and as far around it as that can travel while the shutter is
    open, max|v| shutter / (2 fps): a renderer looks the velocity up where the smoke is drawn, not where it came from.
    Beyond the arrays it goes on as it is in their outermost cells.

    Args:
        path: the file to write.
        density: (nx, ny, nz) at cell centres [-].
        temperature: (nx, ny, nz) at cell centres [K]; stored as the difference to the ambient temperature.
        velocity: (nx, ny, nz, 3) at cell centres, world axes [m/s].
        origin: lower corner of the smoke's box [m]; the centre of cell (i, j, k) is origin + (i + 1/2, ...) cell_size.
        cell_size: edge of a cell [m].
        ambient_temperature: of the air [K].
        parameters: tolerance and precision.
        fps: frames a second of simulated time [1/s].
        shutter: how long the shutter is open [frames].
        first_cell: of the smoke's box, where arrays begin that hold all of its smoke, and the velocity around it.

    Raises:
        ValueError: shapes do not fit together, or a value is not finite.
        OSError: the file cannot be written, or the disk is full.
        VolumeUnavailableError: there is no OpenVDB on this machine.
    """
    smoke = _checked("density", density, 3, first_cell)
    heat = _checked("temperature", temperature, 3, first_cell) - np.float32(ambient_temperature)
    wind = _checked("velocity", velocity, 4, first_cell)
    if not smoke.shape == heat.shape == wind.shape[:3] or wind.shape[3] != 3:
        raise ValueError(
            f"the fields need one grid of cells: density {smoke.shape}, temperature {heat.shape}, velocity {wind.shape}"
        )
    openvdb = import_openvdb()
    is_smoke, is_hot = smoke > parameters.tolerance, np.abs(heat) > TEMPERATURE_TOLERANCE_K
    moving, moving_from = _around(is_smoke | is_hot, wind, shutter_s=shutter / fps, cell_size=float(cell_size))
    half = parameters.half_precision
    grids = [
        _grid(openvdb.FloatGrid(), "density", smoke, is_smoke, half=half, first_cell=first_cell),
        _grid(openvdb.FloatGrid(), "temperature", heat, is_hot, half=half, first_cell=first_cell),
        _grid(openvdb.Vec3SGrid(), "velocity", wind, moving, moving_from, half=half, first_cell=first_cell),
    ]
    transform = openvdb.createLinearTransform(float(cell_size))
    transform.postTranslate(tuple(float(corner) + 0.5 * float(cell_size) for corner in origin))
    for grid in grids:
        grid.transform = transform
        grid.creator = CREATOR
    for grid in grids[:2]:
        grid.gridClass = openvdb.GridClass.FOG_VOLUME
    grids[1]["ambient_temperature"] = float(ambient_temperature)
    grids[2].vectorType = openvdb.VectorType.CONTRAVARIANT_RELATIVE
    grids[2]["is_local_space"] = False
    for grid, unit in zip(grids, ("dimensionless", "K above ambient_temperature", "m/s, at cell centres"), strict=True):
        grid["unit"] = unit
    path.touch()  # where that is impossible, the system's reason is clearer than OpenVDB's
    openvdb.write(str(path), grids)
    vdb_file.sign(path)


def validate_volume(path: Path) -> None:
    """Decode a volume fully: written by `write_volume` and unchanged since, all grids there, every value finite.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
        VolumeUnavailableError: there is no OpenVDB on this machine.
    """
    for grid in _read_grids(path).values():
        low, high = grid.evalActiveVoxelBoundingBox()
        if grid.activeVoxelCount() == 0:
            continue
        for start in range(low[0], high[0] + 1, _SLAB):
            stop = min(start + _SLAB, high[0] + 1)
            values = _dense(grid, (start, low[1], low[2]), (stop, high[1] + 1, high[2] + 1))
            if not np.isfinite(values).all():
                raise InvalidFileError(path, f'grid "{grid.name}" has values that are not finite')


def _checked(name: str, values: ArrayLike, dimensions: int, first_cell: tuple[int, int, int]) -> Float32Array:
    array = np.asarray(values, np.float32)
    if array.ndim != dimensions:
        raise ValueError(f"{name} must have {dimensions} dimensions, got the shape {array.shape}")
    for start in range(0, array.shape[0], _SLAB):
        finite = np.isfinite(array[start : start + _SLAB])
        if not finite.all():
            place = np.argwhere(~finite)[0]
            cell = tuple(int(a + b) for a, b in zip(place[:3], (first_cell[0] + start, *first_cell[1:]), strict=True))
            raise ValueError(f"{name} of cell {cell} is not finite")
    return array


def _around(
    drawn: NDArray[np.bool_], wind: Float32Array, *, shutter_s: float, cell_size: float
) -> tuple[NDArray[np.bool_], tuple[int, int, int]]:
    """The cells that smoke may be drawn in: a mask, and the cell of the arrays, maybe outside, that it begins at."""
    box = bounding_box(drawn)
    if box is None:
        return np.zeros((0, 0, 0), np.bool_), (0, 0, 0)
    reach = blur_reach(wind[box], drawn[box], shutter_s=shutter_s, cell_size=cell_size)
    x, y, z = (part.start - reach for part in box)
    return grown(drawn[box], reach), (x, y, z)


def _grid(
    grid: Any,
    name: str,
    values: Float32Array,
    keep: NDArray[np.bool_],
    keep_from: tuple[int, int, int] = (0, 0, 0),
    *,
    half: bool,
    first_cell: tuple[int, int, int],
) -> Any:
    """Fill an empty grid with the values to keep; everything else is its background, zero.

    `keep` begins at the cell `keep_from` of the values; what it has beyond their sides is as at the sides. Cell (0, 0,
    0) of the values gets the index `first_cell` in the grid.
    """
    grid.name = name
    largest = 0.0
    for part in _parts(keep, [a + b for a, b in zip(keep_from, first_cell, strict=True)]):
        low = tuple(side.start + shift for side, shift in zip(part, keep_from, strict=True))
        mask = keep[part] if values.ndim == 3 else keep[part][..., None]
        block = np.where(mask, _continued(values, low, keep[part].shape), np.float32(0.0))
        largest = max(largest, float(block.max()), -float(block.min()))
        # copyFromArray ignores strides: anything but a C-contiguous array arrives scrambled.
        grid.copyFromArray(np.ascontiguousarray(block), ijk=tuple(a + b for a, b in zip(low, first_cell, strict=True)))
    grid.saveFloatAsHalf = half and largest <= HALF_MAX
    return grid


def _parts(keep: NDArray[np.bool_], index: Sequence[int]) -> Iterator[Box]:
    """Boxes that hold all cells to keep: columns along z without the empty space below and above them.

    Cell (0, 0, 0) has this index in the grid: columns begin where leaves of the tree do, so that none is made twice.
    """
    starts = [range(-(first % _COLUMN), length, _COLUMN) for first, length in zip(index, keep.shape, strict=True)]
    for x, y in itertools.product(*starts[:2]):
        corner = max(x, 0), max(y, 0)
        box = bounding_box(keep[corner[0] : x + _COLUMN, corner[1] : y + _COLUMN])
        if box is not None:
            i, j = (slice(side.start + low, side.stop + low) for side, low in zip(box[:2], corner, strict=True))
            yield i, j, box[2]


def _continued(values: Float32Array, low: Sequence[int], shape: Sequence[int]) -> Float32Array:
    """Values of a box of cells that begins at `low`; beyond the array they are as in its outermost cells."""
    inside, beyond = [], []
    for start, length, n in zip(low, shape, values.shape, strict=False):
        first, stop = min(max(start, 0), n - 1), min(max(start + length, 1), n)
        before = min(max(-start, 0), length - 1)
        inside.append(slice(first, stop))
        beyond.append((before, length - before - (stop - first)))
    part = values[tuple(inside)]
    if not any(map(any, beyond)):
        return part
    return np.pad(part, beyond + [(0, 0)] * (values.ndim - 3), mode="edge")


def _dense(grid: Any, start: Sequence[int], stop: Sequence[int]) -> Float32Array:
    shape = tuple(high - low for low, high in zip(start, stop, strict=True))
    values = np.zeros(shape if grid.valueTypeName == "float" else (*shape, 3), np.float32)
    grid.copyToArray(values, ijk=tuple(start))
    return values


def _read_grids(path: Path) -> dict[str, Any]:
    vdb_file.check(path)
    openvdb = import_openvdb()
    try:
        grids, _ = openvdb.readAll(str(path))
    except (RuntimeError, LookupError, ValueError, TypeError) as error:
        raise InvalidFileError(path, f"OpenVDB cannot read it: {error}") from error
    types = {grid.name: grid.valueTypeName for grid in grids}
    if types != GRID_TYPES:
        raise InvalidFileError(path, f"has the grids {types}, but needs {GRID_TYPES}")
    by_name = {grid.name: grid for grid in grids}
    return {name: by_name[name] for name in GRID_TYPES}
