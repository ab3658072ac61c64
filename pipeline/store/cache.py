"""The HDF5 cache: one file a frame with every body in it, and checkpoints apart. Format: docs/guide/cache-format.md.

The same arrays give the same bytes: HDF5 stores no times here, and groups and attributes are written in a fixed order.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import h5py
import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from pipeline.base.errors import InvalidArtifactError
from pipeline.kinds.smoke_codec import read_density
from pipeline.kinds.stored_arrays import read_array, unit_of, write_array
from pipeline.store.body_groups import BodyGroup, BodyGroups, OneOfGroup, packed
from sim.core.snapshots import Attribute, Snapshot
from sim.core.solver import Diagnostics
from sim.core.world import FrameReport

if TYPE_CHECKING:
    from pipeline.kinds.base import Codec

FRAME_FORMAT = "physics-pipeline frame"
CHECKPOINT_FORMAT = "physics-pipeline checkpoint"
FORMAT_VERSION = 1

GROWTH_BYTES = 4 << 20  # step by which a file in memory grows


@dataclass(frozen=True)
class CachedFrame:
    """A frame as read back from the cache."""

    frame: int
    time_s: float
    device: str
    bodies: Mapping[str, Snapshot]
    diagnostics: Mapping[str, Diagnostics]


@dataclass(frozen=True)
class FrameNumbers:
    """Numbers of a frame, without any array."""

    frame: int
    time_s: float  # simulated
    device: str
    solvers: Mapping[str, Diagnostics]
    kinds: Mapping[str, str]  # of bodies by name, as which solvers of one body go


@dataclass(frozen=True)
class Checkpoint:
    """All that the simulation needs to continue after a frame."""

    frame: int
    fingerprint: str
    device: str
    arrays: Mapping[str, NDArray[np.generic]]


def write_frame(
    path: Path,
    bodies: Mapping[str, Snapshot],
    report: FrameReport,
    *,
    device: str,
    longest_shutter_s: float | None = None,
) -> None:
    """Write the bodies of one frame, by name, with its report and the device that computed it.

    What no picture shows of a smoke whose shutter is open `longest_shutter_s` [s] at the longest is left out, and the
    rest rounded (`kinds.smoke_codec`). None keeps smoke as it is.

    Raises InvalidArtifactError: a value of a smoke is not finite.
    """
    with _new_file(path) as file:
        file.attrs["format"] = FRAME_FORMAT
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["frame"] = report.frame
        file.attrs["time_s"] = report.time_s
        file.attrs["device"] = device
        for name, snapshot in packed(bodies).items():
            group = file.create_group(f"bodies/{name}")
            group.attrs["kind"] = snapshot.kind
            for key, value in snapshot.attributes.items():
                group.attrs[key] = value
            codec = _codec_of(snapshot.kind)
            if codec is not None and longest_shutter_s is not None:
                codec.write(group, name, snapshot, longest_shutter_s=longest_shutter_s)
            else:
                for key, array in snapshot.arrays.items():
                    write_array(group, key, array)
            for key in snapshot.arrays:
                group[key].attrs["units"] = unit_of(snapshot.kind, key)
        for name, diagnostics in report.diagnostics.items():
            group = file.create_group(f"diagnostics/{name}")
            group.attrs["substeps"] = report.substeps.get(name, 0)
            group.attrs["smallest_dt_s"] = report.smallest_dt_s.get(name, 0.0)
            for key, value in diagnostics.items():
                group.attrs[key] = value
        file.attrs["complete"] = True


def read_frame(path: Path, body: str | None = None, *, kind: str | None = None) -> CachedFrame:
    """Read one frame, or one body of it, or its bodies of one kind; errors as of `open_bodies`."""
    with _frame(path) as file:
        groups = BodyGroups(file.get("bodies", {}))
        names = [body] if body is not None else list(groups)
        if kind is not None:
            names = [name for name in names if _kind_of(groups[name]) == kind]
        return CachedFrame(
            frame=int(file.attrs["frame"]),
            time_s=float(file.attrs["time_s"]),
            device=str(file.attrs["device"]),
            bodies={name: _read_body(groups[name]) for name in names},
            diagnostics=_read_diagnostics(file),
        )


def read_compact(path: Path, body: str) -> Any:
    """Read a body of a frame as its kind's product is made of it: its snapshot, or what the kind's codec reads."""
    with open_bodies(path) as groups:
        codec = _codec_of(_kind_of(groups[body]))
        return _read_body(groups[body]) if codec is None else codec.read(groups[body])


@contextmanager
def open_bodies(path: Path) -> Iterator[BodyGroups]:
    """The groups of a frame's bodies, by name.

    Raises InvalidArtifactError: the file is truncated, damaged or of another format.
    """
    with _frame(path) as file:
        yield BodyGroups(file.get("bodies", {}))


def read_smoke_density(path: Path, name: str) -> tuple[NDArray[np.float32], tuple[float, float, float], float]:
    """Read a smoke's density alone, without the empty space around it: `smoke_codec.read_density`."""
    with open_bodies(path) as groups:
        return read_density(groups[name])


def read_numbers(path: Path, only: Collection[str] | None = None) -> FrameNumbers:
    """Read the diagnostics of a frame without decoding any array: all, or only those named, in a tenth of the time."""
    with _frame(path) as file:
        return FrameNumbers(
            frame=int(file.attrs["frame"]),
            time_s=float(file.attrs["time_s"]),
            device=str(file.attrs["device"]),
            solvers=_read_diagnostics(file, only),
            kinds=BodyGroups(file.get("bodies", {})).kinds(),
        )


def _frame(path: Path) -> AbstractContextManager[h5py.File]:
    return _opened(path, FRAME_FORMAT, "frame of the cache")


@contextmanager
def _opened(path: Path, format_name: str, what: str) -> Iterator[h5py.File]:
    """A file of a format, open for reading; what fails with it is told as an InvalidArtifactError."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != format_name or not file.attrs.get("complete", False):
                raise InvalidArtifactError(f"{path}: not a complete {format_name}")
            version = file.attrs["format_version"]
            if version != FORMAT_VERSION:
                raise InvalidArtifactError(f"{path}: format version {version}, this program reads {FORMAT_VERSION}")
            yield file
    except (OSError, KeyError, RuntimeError) as error:
        raise InvalidArtifactError(f"{path}: not a readable {what}: {error}") from error


@contextmanager
def _new_file(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file that is made in memory, byte for byte as HDF5 writes it to the disk, and written when it is whole.

    HDF5 must not meet a full disk itself: what it cannot write stays open, is tried again and again, and ends the
    process with a segmentation fault when that exits (HDF5 2.0).

    Raises OSError: it cannot be written, maybe as the disk is full.
    """
    with h5py.File(
        path, "w", libver=("v108", "v110"), driver="core", backing_store=False, block_size=GROWTH_BYTES
    ) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


def validate_frame(path: Path) -> None:
    """Decode every array; raises InvalidArtifactError if one is damaged or not finite."""
    with _frame(path) as file:
        _read_diagnostics(file)
        for name, group in file.get("bodies", {}).items():
            sparse = _sparse(group)
            for key, dataset in group.items():
                for part in sparse.get(key, [()]):
                    array = dataset[part]
                    if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                        raise InvalidArtifactError(f'{path}: {key} of "{name}" holds values that are not finite')


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; uncompressed, as it is written often and lives briefly."""
    with _new_file(path) as file:
        file.attrs["format"] = CHECKPOINT_FORMAT
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["frame"] = checkpoint.frame
        file.attrs["fingerprint"] = checkpoint.fingerprint
        file.attrs["device"] = checkpoint.device
        file.attrs["digest"] = _digest(checkpoint)
        arrays = file.create_group("arrays")  # also where nothing has a state, as of bodies that stand still
        for key, array in checkpoint.arrays.items():
            data = np.asarray(array)
            if data.ndim and data.size:
                arrays.create_dataset(key, data=data, fletcher32=True)
            else:
                arrays.create_dataset(key, data=data)
        file.attrs["complete"] = True


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises InvalidArtifactError when it is not whole."""
    arrays: dict[str, NDArray[np.generic]] = {}

    def collect(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = read_array(item)

    with _opened(path, CHECKPOINT_FORMAT, "checkpoint") as file:
        file["arrays"].visititems(collect)
        attributes = file.attrs
        checkpoint = Checkpoint(
            int(attributes["frame"]), str(attributes["fingerprint"]), str(attributes["device"]), arrays
        )
        if attributes["digest"] != _digest(checkpoint):
            raise InvalidArtifactError(f"{path}: not the checkpoint that was written")
    return checkpoint


def _digest(checkpoint: Checkpoint) -> str:
    """blake3 of everything in a checkpoint, in hexadecimal.

    HDF5 sums up the arrays, not what says how to read them: one flipped bit in 200 that matter would go unnoticed, and
    a simulation that continues from it would differ.
    """
    hasher = blake3(f"{checkpoint.frame} {checkpoint.fingerprint} {checkpoint.device}".encode())
    for key in sorted(checkpoint.arrays):
        array = np.ascontiguousarray(checkpoint.arrays[key])
        hasher.update(f"\n{key} {array.dtype.str} {array.shape}\n".encode())
        hasher.update(array.reshape(-1).view(np.uint8).data)
    return hasher.hexdigest()


def _read_body(group: BodyGroup) -> Snapshot:
    if isinstance(group, OneOfGroup):
        return group.snapshot()
    attributes: dict[str, Attribute] = {}
    for key, value in group.attrs.items():
        if key != "kind":
            attributes[key] = tuple(float(item) for item in value) if np.ndim(value) else _plain(value)
    # That all of a sparse array is empty is no reason for suspicion.
    sparse = _sparse(group)
    arrays = {key: np.asarray(item[()]) if key in sparse else read_array(item) for key, item in group.items()}
    return Snapshot(_kind_of(group), arrays, attributes)


def _codec_of(kind: str) -> Codec | None:
    from pipeline.kinds.table import KINDS  # a few numbers, as `status` reads them, are read without all models

    row = KINDS.get(kind)
    return None if row is None or row.codec is None else row.codec()


def _sparse(group: BodyGroup) -> Mapping[str, Iterable[Any]]:
    codec = _codec_of(_kind_of(group))
    return {} if codec is None else codec.sparse(group)


def _kind_of(group: BodyGroup) -> str:
    return str(group.attrs["kind"])


def _read_diagnostics(file: h5py.File, only: Collection[str] | None = None) -> dict[str, Diagnostics]:
    return {
        name: {key: float(group.attrs[key]) for key in _keys_of(group.attrs, only)}
        for name, group in file.get("diagnostics", {}).items()
    }


def _keys_of(attributes: h5py.AttributeManager, only: Collection[str] | None) -> list[str]:
    """Keys of attributes: all, or those that are named, by the whole name or, with `*`, by its beginning."""
    if only is None:
        return list(attributes)
    found = [key for key in only if key in attributes]
    beginnings = tuple(key.removesuffix("*") for key in only if key.endswith("*"))
    return [*found, *(key for key in attributes if key.startswith(beginnings))] if beginnings and found else found


def _plain(value: Any) -> Attribute:
    return cast(Attribute, value.item() if isinstance(value, np.generic) else value)
