"""Parameter sets: everything but the inputs that decides a task's outputs.

A parameter set holds what the stage reads of the job, the stage's version, the versions of the tools that do the work
and the hashes of files from outside the job's folder. Comments, key order and keys that the stage does not read are
not in it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from blake3 import blake3
from pydantic import BaseModel

_SHOWN_LENGTH = 80  # longest value shown in full when a change is described [characters]


def digest_of(text: str) -> str:
    """blake3 of a text, in hexadecimal."""
    return blake3(text.encode()).hexdigest()


@dataclass(frozen=True)
class ParameterSet:
    """Canonical JSON of everything but the inputs that decides a task's outputs."""

    canonical: str

    @cached_property
    def digest(self) -> str:
        """Digest of the canonical text."""
        return digest_of(self.canonical)

    @classmethod
    def of(
        cls,
        values: Mapping[str, Any] | None = None,
        /,
        *,
        stage: str,
        version: int,
        tools: Mapping[str, str],
        **more: Any,
    ) -> ParameterSet:
        """Collect parameters, by name; models and plain JSON values alike, in any order.

        A name in `values` may be one of the words that follow. `tools` are versions of what does the work.

        Raises ValueError: two parameters share a name, or a value is not a finite number.
        """
        document = {"stage_name": stage, "stage_version": version, "tools": dict(tools)}
        for name, value in (*(values or {}).items(), *more.items()):
            if name in document:
                raise ValueError(f"two parameters of stage {stage} are called {name}")
            document[name] = _plain(value)
        return cls(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False))


def explain_difference(old: ParameterSet, new: ParameterSet) -> list[str]:
    """Name what changed from one parameter set to another, by its path in the job file, a clause each.

    As `camera.position changed from [3, 2, 1] to [4, 2, 1]`; tables of a list are called by their names, as in
    `fluid[water].viscosity`.
    """
    return [*_differences("", json.loads(old.canonical), json.loads(new.canonical))]


def _differences(path: str, old: Any, new: Any) -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            yield from _member_differences(f"{path}.{key}" if path else key, key, old, new)
    elif _is_list_of_tables(old) and _is_list_of_tables(new):
        old_tables, new_tables = _by_name(old), _by_name(new)
        for name in dict.fromkeys([*old_tables, *new_tables]):
            yield from _member_differences(f"{path}[{name}]", name, old_tables, new_tables)
        if sorted(old_tables) == sorted(new_tables) and list(old_tables) != list(new_tables):
            yield f"{path} changed its order"
    elif json.dumps(old) != json.dumps(new):  # as the digest sees it: 1 and 1.0 differ
        yield f"{path} changed from {_show(old)} to {_show(new)}"


def _member_differences(path: str, key: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    if key not in old:
        yield f"{path} was added: {_show(new[key])}"
    elif key not in new:
        yield f"{path} was removed: {_show(old[key])}"
    else:
        yield from _differences(path, old[key], new[key])


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def _by_name(tables: list[dict[str, Any]]) -> dict[str, Any]:
    """Tables under their names where all have one of their own, else under their positions."""
    names = [str(table.get("name", "")) for table in tables]
    if "" in names or len(set(names)) < len(names):
        names = [str(index) for index in range(len(tables))]
    return dict(zip(names, tables, strict=True))


def _show(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= _SHOWN_LENGTH else f"{text[: _SHOWN_LENGTH - 3]}..."


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
