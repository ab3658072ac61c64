"""Changes to a job from outside its file: `--set path.to.key=value`, and what the presets are made of.

Changes go into the TOML text itself, so the copy in the job's folder keeps the user's comments and says everything.
"""

import tomllib
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from pipeline.job import schema
from pipeline.model.positions import KeyPath
from pipeline.model.problems import format_path, suggestion
from sim.core.parameters import composed

INSTEAD = {"frames": "duration", "duration": "frames"}
"""Keys of which a job has one: what sets one takes the other away."""


class OverrideError(ValueError):
    """An override that cannot be applied; the text says why, and what would do."""


@dataclass(frozen=True, slots=True)
class Override:
    """One key and the value that replaces it."""

    path: KeyPath  # where it goes; every array index exists
    value: Any  # a TOML value as Python has it
    origin: str  # the option it comes from, as shown in messages


def parse_override(argument: str, document: Mapping[str, Any]) -> Override:
    """Read `path.to.key=value`; the path may name an element by its index or its `name` in the job file as parsed.

    As `render.quality=final`, `fluid.water.viscosity=1e-3`, `camera.position=[1, 2, 3]`.

    Raises OverrideError: no `=`, a path that no job has, an element that this job does not have.
    """
    written_path, equals, written_value = argument.partition("=")
    written_path = unicodedata.normalize("NFC", written_path.strip())
    if not equals or not written_path:
        raise OverrideError(f"--set {argument}: expected path.to.key=value")
    path, node = _resolve(written_path, document)
    value = _parse_value(written_value.strip())
    if node.is_array_of_tables:
        if not (isinstance(value, list) and all(isinstance(each, dict) for each in value)):
            raise OverrideError(
                f"--set {argument}: {format_path(path)} is a list of tables; give all of it, such as [{{...}}], with "
                f"the keys {', '.join(node.keys)}, or set a key of one"
            )
    elif node.is_table and (isinstance(path[-1], int) or not isinstance(value, dict)):
        raise OverrideError(f"--set {argument}: {format_path(path)} is a table; set its keys: {', '.join(node.keys)}")
    return Override(path, value, "--set")


def apply_overrides(text: str, overrides: Sequence[Override]) -> str:
    """The TOML text with the overrides in it; comments and order stay.

    Raises OverrideError: a key on the way holds something else than a table.
    """
    try:
        document = tomlkit.parse(text)
        for override in overrides:
            _put(document, override)
        given = {override.path[0] for override in overrides}
        for key, instead in INSTEAD.items():
            if key in given and instead not in given:
                document.pop(instead, None)
        return tomlkit.dumps(document)
    except TOMLKitError as error:
        raise OverrideError(f"cannot edit the job file: {error}") from error


def without_key(text: str, key: str) -> str:
    """The TOML text without a key of its first level; comments and order of the others stay."""
    document = tomlkit.parse(text)
    document.pop(key, None)
    return tomlkit.dumps(document)


def _put(document: Any, override: Override) -> None:
    table = document
    for part in override.path[:-1]:
        if isinstance(part, str) and _written(table, part) not in table:
            table[part] = tomlkit.table()
        if isinstance(part, int) and part >= len(table):
            raise OverrideError(f"{override.origin}: {format_path(override.path)} is not there once the list is set")
        table = table[_written(table, part)]
        if not isinstance(table, Mapping | Sequence) or isinstance(table, str):
            raise OverrideError(f"{override.origin}: {format_path((part,))} is not a table in the job file")
    table[override.path[-1]] = override.value


def _written(table: Any, part: str | int) -> Any:
    """A key as the file has it, maybe with letters that are not composed."""
    keys = table if isinstance(part, str) and isinstance(table, Mapping) else ()
    return next((key for key in keys if unicodedata.normalize("NFC", key) == part), part)


def _parse_value(written: str) -> Any:
    """A TOML value; what is none, such as a bare word, is meant as a text."""
    try:
        return tomllib.loads(f"value = {written}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return written


def _resolve(written_path: str, document: object) -> tuple[KeyPath, schema.SchemaNode]:
    path: KeyPath = ()
    node = schema.root()
    for word in written_path.split("."):
        part = _element(word, document, path, written_path) if node.is_array else word
        child = node.narrowed(document).child(part)
        if not child.alternatives:
            raise OverrideError(_unknown_key(written_path, word, path, node.narrowed(document)))
        path, node = (*path, part), child
        document = _below(document, part)
    return path, node


def _unknown_key(written_path: str, word: str, path: KeyPath, node: schema.SchemaNode) -> str:
    place = f"in {format_path(path)}" if path else "in a job"
    hint = suggestion(word, node.keys)
    known = f"; known here: {', '.join(node.keys)}" if node.keys and not hint else ""
    return f'--set {written_path}: no key "{word}" {place}{hint}{known}'


def _element(word: str, document: object, path: KeyPath, written_path: str) -> int:
    """The index that a word stands for in the array at `path`."""
    elements = document if isinstance(document, list) else []
    names = [composed(each["name"]) if isinstance(each, Mapping) and "name" in each else None for each in elements]
    if word in names:
        return names.index(word)
    if word.isdecimal() and int(word) < len(elements):
        return int(word)
    array = format_path(path)
    if not elements:
        raise OverrideError(f"--set {written_path}: the job has no {array} to change")
    known = ", ".join(str(index) if name is None else f"{index} ({name})" for index, name in enumerate(names))
    hint = suggestion(word, [name for name in names if isinstance(name, str)])
    raise OverrideError(f'--set {written_path}: no element "{word}" in {array}{hint or f"; it has {known}"}')


def _below(document: object, part: str | int) -> object:
    if isinstance(document, Mapping):
        return document.get(part)
    if isinstance(document, list) and isinstance(part, int):
        return document[part]
    return None
