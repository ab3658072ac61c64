"""Groups of rigid bodies in a frame: their poses lie in the rows of four arrays, and each body is read as one of them.

A group of the HDF5 file that has the attribute `bodies` holds so many of them: NAME_1 in the first row, NAME_2 in the
second. A thousand bodies are four datasets, not four thousand.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.stored_arrays import read_array
from sim.core.snapshots import Snapshot

COUNT = "bodies"
"""Attribute of what holds a group: how many bodies are in it."""


def packed(bodies: Mapping[str, Snapshot]) -> dict[str, Snapshot]:
    """Snapshots by name, those of a group as one, by the name of the group, in place of its first body."""
    members: dict[str, list[Snapshot]] = {}
    for name, snapshot in bodies.items():
        if snapshot.group not in (None, name):
            members.setdefault(str(snapshot.group), []).append(snapshot)
    whole: dict[str, Snapshot] = {}
    for name, snapshot in bodies.items():
        if snapshot.group in (None, name):
            whole[name] = snapshot
        elif snapshot.group not in whole:
            whole[str(snapshot.group)] = _stacked(members[str(snapshot.group)])
    return whole


def _stacked(members: list[Snapshot]) -> Snapshot:
    first = members[0]
    arrays = {key: np.stack([each.arrays[key] for each in members]) for key in first.arrays}
    return Snapshot(first.kind, arrays, {**first.attributes, COUNT: len(members)})


class OneOfGroup:
    """One body of a group: what an HDF5 group of it alone would be, for reading.

    Attributes:
        attrs: its attributes.
    """

    def __init__(self, group: str, attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], row: int) -> None:
        self.attrs = {key: value for key, value in attributes.items() if key != COUNT}
        self._group, self._arrays, self._row = group, arrays, row

    def __getitem__(self, key: str) -> NDArray[Any]:
        row: NDArray[Any] = self._arrays[key][self._row]
        return row

    def __contains__(self, key: str) -> bool:
        return key in self._arrays

    def snapshot(self) -> Snapshot:
        """The body with copies of its arrays."""
        arrays = {key: array[self._row].copy() for key, array in self._arrays.items()}
        own = {key: value for key, value in self.attrs.items() if key != "kind"}
        return Snapshot(str(self.attrs["kind"]), arrays, own, self._group)


BodyGroup: TypeAlias = h5py.Group | OneOfGroup


class BodyGroups(Mapping[str, Any]):
    """The bodies of a frame by name, those of groups one by one; a group is read once, when the first is asked for."""

    def __init__(self, groups: Mapping[str, h5py.Group]) -> None:
        self._groups = groups
        self._rows: dict[str, tuple[str, int]] = {}  # of bodies in groups: their group and row
        for name in groups:
            count = groups[name].attrs.get(COUNT)
            if count is not None:
                self._rows |= {f"{name}_{row + 1}": (name, row) for row in range(int(count))}
        of_groups = {group for group, _ in self._rows.values()}
        self._names = [*(name for name in groups if name not in of_groups), *self._rows]
        self._read: dict[str, tuple[dict[str, Any], dict[str, NDArray[Any]]]] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._rows or name in self._names

    def __getitem__(self, name: str) -> Any:
        if name not in self._rows:
            return self._groups[name]
        group, row = self._rows[name]
        if group not in self._read:
            found = self._groups[group]
            self._read[group] = dict(found.attrs), {key: read_array(item) for key, item in found.items()}
        return OneOfGroup(group, *self._read[group], row)

    def kinds(self) -> dict[str, str]:
        """The kind of each body, by its name; no array is read."""
        of_groups = {name: str(group.attrs["kind"]) for name, group in self._groups.items()}
        return {name: of_groups[self._rows[name][0] if name in self._rows else name] for name in self._names}
