"""The job file's JSON Schema, and what the rest of the loader asks of it: keys, units, kinds of a path."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from pipeline.kinds.table import job_type
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath

Node = dict[str, Any]

_UNIT = re.compile(r"\[([^\[\]]+)\]")


def job_schema() -> Node:
    """JSON Schema (draft 2020-12) of the job file; editors complete and check TOML with it."""
    return _schema_of(job_type())


@cache
def _schema_of(model: type[Job]) -> Node:
    schema = model.model_json_schema()
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "Job file",
        "description": "A film of simulated physics: the scene, how it moves, and how it is shown. SI units, z up.",
        **{key: value for key, value in schema.items() if key not in ("title", "description")},
    }


@dataclass(frozen=True)
class SchemaNode:
    """A place in the schema: the alternatives that a value there may take; none where there is no such place."""

    alternatives: tuple[Node, ...]
    description: str = ""

    @property
    def unit(self) -> str:
        """The unit in the description's first brackets, or nothing where there is none to print after a number."""
        match = _UNIT.search(self.description)
        unit = match.group(1) if match else "-"
        return "" if unit == "-" or unit.startswith("1/") else unit

    @property
    def keys(self) -> list[str]:
        """Keys that a table here, or a table of the array here, may have."""
        if self.is_array_of_tables:
            return self.child(0).keys
        return list(dict.fromkeys(key for node in self.alternatives for key in node.get("properties", {})))

    @property
    def is_table(self) -> bool:
        """Whether a table may stand here."""
        return any(node.get("type") == "object" for node in self.alternatives)

    @property
    def is_open(self) -> bool:
        """Whether a table here takes any key, as `material` does."""
        return any(isinstance(node.get("additionalProperties"), dict) for node in self.alternatives)

    @property
    def is_positive(self) -> bool:
        """Whether a number here must be above zero."""
        return any("exclusiveMinimum" in node for node in self.alternatives)

    @property
    def is_array(self) -> bool:
        """Whether this is a list, and nothing else but absent."""
        return {node.get("type") for node in self.alternatives} - {"null"} == {"array"}

    @property
    def is_array_of_tables(self) -> bool:
        """Whether this is written `[[so]]`."""
        return any("items" in node and _resolve(node["items"]).is_table for node in self.alternatives)

    def narrowed(self, value: object) -> SchemaNode:
        """The alternatives that a table may still be meant as, judged by its constants, such as a shape's `type`."""
        if not isinstance(value, dict):
            return self
        fitting = tuple(node for node in self.alternatives if _constants(node).items() <= value.items())
        return SchemaNode(fitting or self.alternatives, self.description)

    def child(self, part: str | int) -> SchemaNode:
        """Schema under a key or an index."""
        found = [place for node in self.alternatives if (place := _child(node, part)) is not None]
        alternatives = tuple(node for place in found for node in place.alternatives)
        inherited = self.description if isinstance(part, int) else ""  # an element has its vector's unit
        return SchemaNode(alternatives, next((place.description for place in found if place.description), inherited))


def root() -> SchemaNode:
    """The whole job."""
    return _resolve(job_schema())


def node_at(path: KeyPath) -> SchemaNode:
    """The place at a path."""
    return reduce(SchemaNode.child, path, root())


def sections() -> Iterator[tuple[str, SchemaNode]]:
    """Tables that a job has once, such as `render`, by name."""
    top = root()
    for key in top.keys:
        child = top.child(key)
        if child.is_table and not child.is_open:
            yield key, child


def _constants(node: Node) -> Node:
    return {key: child["const"] for key, child in node.get("properties", {}).items() if "const" in child}


def _child(node: Node, part: str | int) -> SchemaNode | None:
    if isinstance(part, str):
        if part in node.get("properties", {}):
            return _resolve(node["properties"][part])
        extra = node.get("additionalProperties")
        return _resolve(extra) if isinstance(extra, dict) else None
    prefix = node.get("prefixItems", [])
    if 0 <= part < len(prefix):
        return _resolve(prefix[part])
    return _resolve(node["items"]) if part >= 0 and isinstance(node.get("items"), dict) else None


def _resolve(node: Node) -> SchemaNode:
    """Follow references and lay alternatives out flat."""
    description = str(node.get("description", ""))
    if "$ref" in node:
        target = job_schema()["$defs"][node["$ref"].rpartition("/")[2]]
        resolved = _resolve(target)
        return SchemaNode(resolved.alternatives, description or resolved.description)
    options = node.get("anyOf") or node.get("oneOf")
    if options:
        resolved_options = [_resolve(option) for option in options]
        return SchemaNode(tuple(each for option in resolved_options for each in option.alternatives), description)
    return SchemaNode((node,), description)
