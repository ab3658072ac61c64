"""Arrays in HDF5 files of the cache: how they are compressed, and what is refused of a damaged file."""

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import InvalidArtifactError

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
"""Every HDF5 build reads gzip; level 1 with byte shuffling gives nearly the size of level 9 at a fifth of the time."""
CHUNK_BYTES = 1 << 20

SMALL_BYTES = 1 << 20
MOST_COMPRESSED = 1100
"""Deflate makes nothing smaller than a thousandth and a bit; what claims more was never written."""

_UNITS = {
    "position": "m",
    "velocity": "m/s",
    "vertices": "m",
    "vertex_velocities": "m/s",
    "angular_velocity": "rad/s",
    "pressure": "Pa",
    "temperature": "K",
    "uv": "m",
    "diameter": "m",
}
_UNITS_BY_KIND = {("fluid", "density"): "kg/m3"}


def unit_of(kind: str, key: str) -> str:
    """Unit of an array of a body of this kind, as other programs read it; "1" of numbers without one."""
    return _UNITS_BY_KIND.get((kind, key)) or _UNITS.get(key, "1")


def write_array(group: h5py.Group, key: str, array: NDArray[np.generic]) -> None:
    """Store an array as it is, compressed where that gains anything."""
    data = np.ascontiguousarray(array)
    if data.ndim == 0 or data.size < 1024:
        group.create_dataset(key, data=data)
        return
    row_bytes = data.nbytes // data.shape[0]
    rows = max(1, min(data.shape[0], CHUNK_BYTES // max(1, row_bytes)))
    group.create_dataset(key, data=data, chunks=(rows, *data.shape[1:]), **COMPRESSION)


def read_array(dataset: h5py.Dataset) -> NDArray[Any]:
    """All of a dataset.

    Raises InvalidArtifactError: it claims to be far larger than what is stored of it.
    """
    require_stored(dataset)
    return np.asarray(dataset[()])


def require_stored(dataset: h5py.Dataset) -> None:
    """Refuse a dataset that claims to be far larger than what is stored of it, before it is read.

    Raises InvalidArtifactError: it does.
    """
    if dataset.nbytes > MOST_COMPRESSED * dataset.id.get_storage_size() + SMALL_BYTES:
        raise InvalidArtifactError(f"{dataset.name}: claims {dataset.nbytes} bytes, and hardly any are stored")
