"""Groups of rigid bodies in a frame: their poses lie in the rows of four arrays, and each body is read as one of them.

A group of the HDF5 file that has the attribute `bodies` holds so many of them: NAME_1 in the first row, NAME_2 in the
second, unless its attribute `names` has their names. A thousand bodies are four datasets, not four thousand.
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
NAMES = "names"
"""Attribute of what holds a group whose bodies have other names than NAME_1 and so on: one a line, as pieces have."""


def packed(bodies: Mapping[str, Snapshot]) -> dict[str, Snapshot]:
    """Snapshots by name, those of a group as one, by the name of the group, in place of its first body.

    Raises ValueError: a group has the name of a body that is none of it.
    """
    of_names: dict[str, dict[str, Snapshot]] = {}
    for name, snapshot in bodies.items():
        of_names.setdefault(snapshot.group or name, {})[name] = snapshot
    if both := [name for name, members in of_names.items() if name in members and len(members) > 1]:
        raise ValueError(f'"{both[0]}" is a body and a group of others; names are unique in a frame')
    return {name: members[name] if name in members else _stacked(name, members) for name, members in of_names.items()}


def _stacked(group: str, members: Mapping[str, Snapshot]) -> Snapshot:
    first = next(iter(members.values()))
    arrays = {key: np.stack([each.arrays[key] for each in members.values()]) for key in first.arrays}
    named = {} if [*members] == _usual_names(group, len(members)) else {NAMES: "\n".join(members)}
    return Snapshot(first.kind, arrays, {**first.attributes, COUNT: len(members), **named})


def _usual_names(group: str, count: int) -> list[str]:
    return [f"{group}_{row + 1}" for row in range(count)]


class OneOfGroup:
    """One body of a group: what an HDF5 group of it alone would be, for reading.

    Attributes:
        attrs: its attributes.
    """

    def __init__(self, group: str, attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], row: int) -> None:
        self.attrs = {key: value for key, value in attributes.items() if key not in (COUNT, NAMES)}
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
            attributes = groups[name].attrs
            if COUNT in attributes:
                said = attributes.get(NAMES)
                members = _usual_names(name, int(attributes[COUNT])) if said is None else str(said).split("\n")
                self._rows |= {member: (name, row) for row, member in enumerate(members)}
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
