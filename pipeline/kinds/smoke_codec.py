"""Codec of smoke in the cache: only where it is, and as exactly as pictures can show it.

Datasets have the shape of the whole box of cells, but chunks of empty space are not in the file: any HDF5 library
reads them as no smoke, air of the ambient temperature, at rest. Checkpoints are exact. See
docs/decisions/0025-smoke-on-disk.md.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import InvalidArtifactError
from pipeline.kinds.stored_arrays import COMPRESSION, require_stored
from render.smoke_region import Box, blur_reach, bounding_box, grown
from sim.core.snapshots import Snapshot
from sim.smoke.parameters import MOST_CELLS

Float32Array = NDArray[np.float32]

GRIDS = ("density", "temperature", "velocity")
CHUNK_CELLS = 32
"""Edge of a chunk: finer ones cost more in calls and in the index than they save."""
DENSITY_BITS = 11
"""Significant bits of a density, as many as 16-bit floats have: wrong by 5e-4 of it at most, and without bias."""
DENSITY_FLOOR = 2.0**-20
"""Below this density there is no smoke: a kilometre of it at 1 per metre takes 1e-3 of the light."""
TEMPERATURE_STEP_K = 0.25
"""Temperatures are multiples of this above the ambient one: at 1000 K wrong by 0.3 % of the light that they emit."""
VELOCITY_STEPS = 64
"""Velocities are multiples of a power of two, such that a cell a frame has as many steps at least: what is drawn is
out of place by 1/256 of a cell at most."""


@dataclass(frozen=True)
class SmokeInBox:
    """The part of a smoke that is not empty, as dense arrays; its fields are keywords of `write_volume`."""

    density: Float32Array  # (nx, ny, nz) float32 [-]
    temperature: Float32Array  # (nx, ny, nz) float32 [K]
    velocity: Float32Array  # (nx, ny, nz, 3) float32 [m/s], at cell centres
    first_cell: tuple[int, int, int]  # which cell of the smoke the arrays begin at
    origin: tuple[float, float, float]  # lower corner of the smoke's whole box [m]
    cell_size: float  # edge of a cell [m]
    ambient_temperature: float  # [K]


def write(group: h5py.Group, name: str, snapshot: Snapshot, *, longest_shutter_s: float) -> None:
    """Write the grids of a smoke into the group of its body.

    The velocity is kept as far around smoke and heat as they are drawn in motion blur with the longest shutter [s].

    Raises InvalidArtifactError: a value is not finite.
    """
    fields = {key: np.asarray(snapshot.arrays[key], np.float32) for key in GRIDS}
    for key, values in fields.items():
        _require_finite(name, key, values)
    density, temperature, velocity = fields.values()
    ambient, cell_size = np.float32(snapshot.number("ambient_temperature")), snapshot.number("cell_size")
    step = 2.0 ** math.floor(math.log2(cell_size / longest_shutter_s / VELOCITY_STEPS))
    present = _present(density, temperature, ambient)
    around, box = _around(present, velocity, shutter_s=longest_shutter_s, cell_size=cell_size)

    chunks = tuple(min(CHUNK_CELLS, n) for n in density.shape)
    datasets = {
        key: group.create_dataset(
            key,
            shape=values.shape,
            dtype=np.float32,
            chunks=chunks if values.ndim == 3 else (*chunks, 1),
            fillvalue=ambient if key == "temperature" else 0.0,
            **COMPRESSION,
        )
        for key, values in fields.items()
    }
    for dataset in datasets.values():
        dataset.attrs["box"] = np.array([[side.start for side in box], [side.stop for side in box]])
    datasets["density"].attrs["significant_bits"] = DENSITY_BITS
    datasets["temperature"].attrs["step"] = TEMPERATURE_STEP_K
    datasets["velocity"].attrs["step"] = step
    for block in _chunks(box, chunks):
        near, here = around[block], present[block]
        if here.any():
            _put(datasets["density"], block, np.where(here, _to_bits(density[block]), np.float32(0.0)))
            _put(datasets["temperature"], block, np.where(here, _to_steps(temperature[block], ambient), ambient))
        if near.any():
            for axis in range(3):
                component = np.rint(velocity[(*block, axis)] / np.float32(step)) * np.float32(step)
                _put(datasets["velocity"], (*block, axis), np.where(near, component, np.float32(0.0)))


def read(group: h5py.Group) -> SmokeInBox:
    """Read the part of a smoke that is not empty, from the group of its body.

    Raises InvalidArtifactError: its grids are none that `write` writes.
    """
    grids = _grids_of(group)
    part = _stored_box(grids["velocity"])
    velocity = np.empty((*(side.stop - side.start for side in part), 3), np.float32)
    for axis in range(3):  # a third faster than all at once, as chunks hold one component each
        velocity[..., axis] = grids["velocity"][(*part, axis)]
    x, y, z = (float(value) for value in group.attrs["origin"])
    return SmokeInBox(
        density=grids["density"][part],
        temperature=grids["temperature"][part],
        velocity=velocity,
        first_cell=(part[0].start, part[1].start, part[2].start),
        origin=(x, y, z),
        cell_size=float(group.attrs["cell_size"]),
        ambient_temperature=float(group.attrs["ambient_temperature"]),
    )


def sparse(group: h5py.Group) -> dict[str, Iterator[Box]]:
    """The grids, each in slabs of the box that is not empty.

    Raises InvalidArtifactError: they are none that `write` writes.
    """
    return {key: _slabs(_stored_box(grid)) for key, grid in _grids_of(group).items()}


def read_density(group: h5py.Group) -> tuple[Float32Array, tuple[float, float, float], float]:
    """Read the density of a smoke, from the group of its body.

    Returns:
        Density of the cells that are not empty (nx, ny, nz) [-], lower corner of the first of them [m], and the edge of
        a cell [m].

    Raises InvalidArtifactError: its grids are none that `write` writes.
    """
    density = _grids_of(group)["density"]
    part, cell_size = _stored_box(density), float(group.attrs["cell_size"])
    x, y, z = (float(low) + side.start * cell_size for low, side in zip(group.attrs["origin"], part, strict=True))
    return density[part], (x, y, z), cell_size


def _grids_of(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """The grids of a smoke by name, not read yet; as empty space is not stored, a small file may claim any size."""
    grids = {key: group.get(key) for key in GRIDS}
    for key, dataset in grids.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
            raise InvalidArtifactError(f"{group.name}: has no grid of {key}")
    shape = grids["density"].shape
    if len(shape) != 3 or math.prod(shape) > MOST_CELLS:
        raise InvalidArtifactError(f"{group.name}: no smoke has a grid of shape {shape}")
    if grids["temperature"].shape != shape or grids["velocity"].shape != (*shape, 3):
        raise InvalidArtifactError(f"{group.name}: its grids differ in shape")
    return grids


def _stored_box(grid: h5py.Dataset) -> Box:
    """The cells outside of which a grid of a smoke holds nothing; all of them where it was stored as it is."""
    shape = grid.shape[:3]
    if "box" not in grid.attrs:
        require_stored(grid)
        return slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2])
    ends = np.asarray(grid.attrs["box"])
    if ends.shape != (2, 3) or not np.issubdtype(ends.dtype, np.integer):
        raise InvalidArtifactError(f"{grid.name}: {ends} is no box of cells")
    if (ends[0] < 0).any() or (ends[0] > ends[1]).any() or (ends[1] > shape).any():
        raise InvalidArtifactError(f"{grid.name}: its box {ends.tolist()} leaves its grid of {shape}")
    x, y, z = (slice(int(low), int(high)) for low, high in ends.T)
    return x, y, z


def _slabs(box: Box) -> Iterator[Box]:
    """Parts of a box that are few cells long along x, so that reading them takes little memory."""
    for start in range(box[0].start, box[0].stop, CHUNK_CELLS):
        yield slice(start, min(start + CHUNK_CELLS, box[0].stop)), box[1], box[2]


def _require_finite(name: str, key: str, values: Float32Array) -> None:
    whole = slice(0, values.shape[0]), slice(None), slice(None)
    for slab in _slabs(whole):
        finite = np.isfinite(values[slab])
        if not finite.all():
            x, y, z = (int(index) for index in np.argwhere(~finite)[0][:3])
            raise InvalidArtifactError(f'{key} of "{name}" is not finite in cell ({slab[0].start + x}, {y}, {z})')


def _present(density: Float32Array, temperature: Float32Array, ambient: np.float32) -> NDArray[np.bool_]:
    """Where there is smoke or heat that is not rounded away, (nx, ny, nz)."""
    present = np.empty(density.shape, np.bool_)
    for slab in _slabs((slice(0, density.shape[0]), slice(None), slice(None))):
        warm = np.abs(temperature[slab] - ambient) > 0.5 * TEMPERATURE_STEP_K
        np.logical_or(density[slab] >= DENSITY_FLOOR, warm, out=present[slab])
    return present


def _around(
    present: NDArray[np.bool_], velocity: Float32Array, *, shutter_s: float, cell_size: float
) -> tuple[NDArray[np.bool_], Box]:
    """Cells that smoke and heat may be drawn in, (nx, ny, nz), and a box of cells around them, if there are any."""
    around = np.zeros_like(present)
    box = bounding_box(present)
    if box is None:
        return around, (slice(0, 0), slice(0, 0), slice(0, 0))
    reach = blur_reach(velocity[box], present[box], shutter_s=shutter_s, cell_size=cell_size)
    x, y, z = (
        slice(max(0, side.start - reach), min(n, side.stop + reach)) for side, n in zip(box, present.shape, strict=True)
    )
    starts = [side.start - reach for side in box]  # of the grown box, beyond the grid or not
    inside = tuple(slice(each.start - a, each.stop - a) for each, a in zip((x, y, z), starts, strict=True))
    around[x, y, z] = grown(present[box], reach)[inside]
    return around, (x, y, z)


def _chunks(box: Box, edges: tuple[int, ...]) -> Iterator[Box]:
    """The chunks of a dataset that have cells in a box, in their order in the file."""
    starts = [range(side.start // edge * edge, side.stop, edge) for side, edge in zip(box, edges, strict=True)]
    for corner in itertools.product(*starts):
        x, y, z = (slice(low, low + edge) for low, edge in zip(corner, edges, strict=True))
        yield x, y, z


def _put(dataset: h5py.Dataset, block: tuple[slice | int, ...], values: Float32Array) -> None:
    """Write a chunk, unless it is empty."""
    if (values != dataset.fillvalue).any():
        dataset[block] = values


def _to_bits(values: Float32Array) -> Float32Array:
    """Round to DENSITY_BITS significant bits, ties to even, and what is below DENSITY_FLOOR to none."""
    dropped = np.uint32(24 - DENSITY_BITS)  # a float32 has 24, one of which is not stored
    bits = np.ascontiguousarray(values).view(np.uint32)
    is_odd = (bits >> dropped) & np.uint32(1)
    rounded = (bits + np.uint32((1 << (int(dropped) - 1)) - 1) + is_odd) >> dropped << dropped
    return np.where(values >= DENSITY_FLOOR, rounded.view(np.float32), np.float32(0.0))


def _to_steps(temperature: Float32Array, ambient: np.float32) -> Float32Array:
    """Round to multiples of TEMPERATURE_STEP_K above the ambient temperature [K]."""
    steps: Float32Array = np.rint((temperature - ambient) / np.float32(TEMPERATURE_STEP_K))
    return ambient + steps * np.float32(TEMPERATURE_STEP_K)
