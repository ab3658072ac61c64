"""Smoke volumes as OpenVDB files: `density`, `temperature` and `velocity` on one grid of cells.

The OpenVDB binding is the one inside the bpy wheel; it is loaded by itself, without importing bpy. Equal arrays give
equal bytes, and a file that was changed is noticed (`vdb_file`). Layout and conventions: docs/formats.md.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render import vdb_file
from render.errors import InvalidFileError, VolumeUnavailableError
from render.parameters import VolumeParameters

Float32Array = NDArray[np.float32]

GRID_TYPES = {"density": "float", "temperature": "float", "velocity": "vec3s"}
TEMPERATURE_TOLERANCE_K = 0.5
"""Air this close to the ambient temperature [K] is stored as ambient; it emits and lifts nothing visible."""

_SLAB = 64


@dataclass(frozen=True)
class Volume:
    """The dense contents of a file over a box of cells.

    Attributes:
        density: (nx, ny, nz) float32 [-].
        temperature: (nx, ny, nz) float32, above ambient [K].
        velocity: (nx, ny, nz, 3) float32 [m/s].
        centre: world position of the centre of cell (0, 0, 0) [m].
        cell_size: edge of a cell [m].
        metadata: metadata of each grid, by the grid's name.
    """

    density: Float32Array
    temperature: Float32Array
    velocity: Float32Array
    centre: tuple[float, float, float]
    cell_size: float
    metadata: dict[str, dict[str, Any]]


def import_openvdb() -> ModuleType:
    """The OpenVDB binding: an installed one, else the one inside the bpy wheel.

    Raises:
        VolumeUnavailableError: there is none, or it cannot be loaded.
    """
    if "openvdb" in sys.modules:
        return sys.modules["openvdb"]
    spec = importlib.util.find_spec("openvdb") or _spec_inside_bpy()
    if spec is None or spec.loader is None:
        raise VolumeUnavailableError(
            "OpenVDB is not installed: it comes inside the bpy wheel, which exists for Python 3.11 and 3.13 on "
            f"Linux and macOS; this is Python {sys.version_info.major}.{sys.version_info.minor} on {sys.platform}"
        )
    try:
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except ImportError as error:
        raise VolumeUnavailableError(f"{spec.origin} cannot be loaded: {error}") from error
    sys.modules["openvdb"] = module
    return module


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
) -> None:
    """Write one frame of smoke; the same arrays give the same bytes.

    The velocity is kept where there is smoke and as far around it as smoke can travel while the shutter is open,
    max|v| shutter / (2 fps): a renderer looks the velocity up where the smoke is drawn, not where it came from.

    Args:
        path: the file to write.
        density: (nx, ny, nz) at cell centres [-].
        temperature: (nx, ny, nz) at cell centres [K]; stored as the difference to the ambient temperature.
        velocity: (nx, ny, nz, 3) at cell centres, world axes [m/s].
        origin: lower corner of the grid [m]; the centre of cell (i, j, k) is origin + (i + 1/2, ...) cell_size.
        cell_size: edge of a cell [m].
        ambient_temperature: temperature of the air [K].
        parameters: tolerance and precision.
        fps: frames a second of simulated time [1/s].
        shutter: how long the shutter is open [frames].

    Raises:
        ValueError: shapes do not fit together, or a value is not finite.
        OSError: the file cannot be written, or the disk is full.
        VolumeUnavailableError: there is no OpenVDB on this machine.
    """
    smoke = _checked("density", density, 3)
    heat = _checked("temperature", temperature, 3) - np.float32(ambient_temperature)
    wind = _checked("velocity", velocity, 4)
    if not smoke.shape == heat.shape == wind.shape[:3] or wind.shape[3] != 3:
        raise ValueError(
            f"the fields need one grid of cells: density {smoke.shape}, temperature {heat.shape}, velocity {wind.shape}"
        )
    openvdb = import_openvdb()
    is_smoke = smoke > parameters.tolerance
    moving, wind = _around_smoke(is_smoke, wind, travel_cells=shutter / (2.0 * fps * cell_size))
    padding = (moving.shape[0] - smoke.shape[0]) // 2

    grids = [
        _grid(openvdb.FloatGrid(), "density", np.where(is_smoke, smoke, 0), is_smoke),
        _grid(openvdb.FloatGrid(), "temperature", heat, np.abs(heat) > TEMPERATURE_TOLERANCE_K),
        _grid(openvdb.Vec3SGrid(), "velocity", wind, moving, first_cell=-padding),
    ]
    transform = openvdb.createLinearTransform(float(cell_size))
    transform.postTranslate(tuple(float(corner) + 0.5 * float(cell_size) for corner in origin))
    for grid in grids:
        grid.transform = transform
        grid.saveFloatAsHalf = parameters.half_precision
    for grid in grids[:2]:
        grid.gridClass = openvdb.GridClass.FOG_VOLUME
    grids[1]["ambient_temperature"] = float(ambient_temperature)
    grids[2].vectorType = openvdb.VectorType.CONTRAVARIANT_RELATIVE
    grids[2]["is_local_space"] = False
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


def read_volume(path: Path, shape: tuple[int, int, int], first_cell: tuple[int, int, int] = (0, 0, 0)) -> Volume:
    """Read a box of cells of a volume into dense arrays.

    Args:
        path: a file by `write_volume`.
        shape: number of cells along x, y, z.
        first_cell: index of the box's lower cell.

    Raises:
        InvalidFileError: the file is not what `write_volume` writes.
    """
    grids = _read_grids(path)
    stop = (first_cell[0] + shape[0], first_cell[1] + shape[1], first_cell[2] + shape[2])
    transform = grids["density"].transform
    return Volume(
        **{name: _dense(grid, first_cell, stop) for name, grid in grids.items()},
        centre=tuple(transform.indexToWorld(first_cell)),
        cell_size=transform.voxelSize()[0],
        metadata={name: dict(grid.metadata) for name, grid in grids.items()},
    )


def _spec_inside_bpy() -> ModuleSpec | None:
    # find_spec of a top-level package locates it without running it.
    bpy = importlib.util.find_spec("bpy")
    for folder in (bpy.submodule_search_locations or ()) if bpy else ():
        for suffix in EXTENSION_SUFFIXES:
            for file in sorted(Path(folder).glob(f"*/python/lib/python3.*/site-packages/openvdb{suffix}")):
                return importlib.util.spec_from_loader("openvdb", ExtensionFileLoader("openvdb", str(file)))
    return None


def _checked(name: str, values: ArrayLike, dimensions: int) -> Float32Array:
    array = np.asarray(values, np.float32)
    if array.ndim != dimensions:
        raise ValueError(f"{name} must have {dimensions} dimensions, got the shape {array.shape}")
    if not np.isfinite(array).all():
        cell = np.argwhere(~np.isfinite(array))[0][:3]
        raise ValueError(f"{name} of cell {tuple(int(index) for index in cell)} is not finite")
    return array


def _around_smoke(
    is_smoke: NDArray[np.bool_], wind: Float32Array, *, travel_cells: float
) -> tuple[NDArray[np.bool_], Float32Array]:
    """Cells that smoke may be drawn in, and their velocity; padded all around, for smoke that leaves the grid.

    Args:
        is_smoke: where there is smoke.
        wind: velocity [m/s].
        travel_cells: cells that something of 1 m/s crosses in half the time that the shutter is open.
    """
    if not is_smoke.any():
        return is_smoke, wind
    from scipy.ndimage import maximum_filter

    fastest = float(np.linalg.norm(wind[is_smoke], axis=-1).max())
    reach = min(math.ceil(fastest * travel_cells) + 1, max(is_smoke.shape))  # + 1: the renderer interpolates
    padded = np.pad(is_smoke, reach)
    moving = maximum_filter(padded, size=2 * reach + 1)
    return moving, np.pad(wind, [(reach, reach)] * 3 + [(0, 0)], mode="edge")


def _grid(grid: Any, name: str, values: NDArray[np.float32], keep: NDArray[np.bool_], *, first_cell: int = 0) -> Any:
    """Fill a grid with the values to keep; everything else is its background, zero."""
    grid.name = name
    cells = np.argwhere(keep.any(axis=(1, 2))), np.argwhere(keep.any(axis=(0, 2))), np.argwhere(keep.any(axis=(0, 1)))
    if cells[0].size:
        low = tuple(int(index[0, 0]) for index in cells)
        box = tuple(slice(int(index[0, 0]), int(index[-1, 0]) + 1) for index in cells)
        mask = keep[box] if values.ndim == 3 else keep[box][..., None]
        # copyFromArray ignores strides: anything but a C-contiguous array arrives scrambled.
        grid.copyFromArray(np.ascontiguousarray(values[box] * mask), ijk=tuple(first_cell + index for index in low))
    return grid


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
