"""The reference of every key in docs/guide/job-file.md, made from the schema.

    python -m pipeline.job.reference docs/guide/job-file.md

writes it between the file's two markers; a test asserts that it is current.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.job import schema
from pipeline.model.problems import quoted_list
from sim.cloth.parameters import MATERIAL_UNITS, MATERIALS, SOURCES

BEGIN = "<!-- reference: begin; written by `python -m pipeline.job.reference docs/guide/job-file.md` -->"
END = "<!-- reference: end -->"

# The key that tables of several types stand under, by the end of their models' names.
_KEYS_OF_TYPED = {
    "Shape": "shape",
    "Opening": "[[fluid.emitter]] shape",
    "Sheet": "[[cloth]] shape",
    "Region": "[[cloth.pin]] region",
    "Force": "[[force]]",
}
_MANY_TYPES = 6
# Title of the table whose keys come from its material.
_CLOTH = "ClothParameters"
_SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def reference() -> str:
    """Markdown: a section with a table of keys for every table of the job file."""
    tables = {heading: (about, node) for heading, about, node in _tables()}  # what several types have, once
    return "\n".join(line for heading, table in tables.items() for line in _section(heading, *table))


def with_reference(document: str) -> str:
    """The document with the current reference between its markers. Raises ValueError where they are missing."""
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the document lacks a marker: {BEGIN if not begin else END}")
    return f"{before}{BEGIN}\n\n{reference()}\n{END}{after}"


def _tables() -> Iterator[tuple[str, str, schema.Node]]:
    """Heading, description and schema of every table, in reading order; shapes once, at the end."""
    definitions = schema.job_schema()["$defs"]
    yield "Top of the file", "", schema.job_schema()
    for key, property_ in schema.job_schema()["properties"].items():
        yield from _nested_tables(key, property_)
    for suffix, key in _KEYS_OF_TYPED.items():
        for name, definition in definitions.items():
            if name.endswith(suffix):
                type_ = f'type = "{definition["properties"]["type"]["const"]}"'
                is_table = key.endswith("]]")
                yield (
                    f"{key} {type_}" if is_table else f"{key} = {{ {type_}, ... }}",
                    definition["description"],
                    definition,
                )
                for child, property_ in definition["properties"].items():
                    if child != "of":
                        yield from _nested_tables(f"{key.strip('[]') if is_table else key}.{child}", property_)


def _nested_tables(path: str, property_: schema.Node) -> Iterator[tuple[str, str, schema.Node]]:
    target, heading = _table_of(path, property_)
    if target is None:
        return
    yield heading, target.get("description", ""), target
    for key, child in target["properties"].items():
        if key != "shape":
            yield from _nested_tables(f"{path}.{key}", child)


def _table_of(path: str, property_: schema.Node) -> tuple[schema.Node | None, str]:
    """The table that a property holds, one or many, and how its header is written."""
    definitions = schema.job_schema()["$defs"]
    options = [option for option in property_.get("anyOf", ()) if option.get("type") != "null"]
    tables = options if len(options) == 1 else [option for option in options if "$ref" in option]
    for node, heading in (
        (property_, f"[{path}]"),
        (tables[0] if tables else None, f"[{path}]"),
        (property_.get("items"), f"[[{path}]]"),
        (property_.get("additionalProperties"), f"[{path}.NAME]"),
    ):
        if isinstance(node, dict) and "$ref" in node:
            return definitions[node["$ref"].rpartition("/")[2]], heading
    return None, ""


def _section(heading: str, about: str, node: schema.Node) -> Iterator[str]:
    yield f"### `{heading}`" if heading.startswith("[") or "=" in heading else f"### {heading}"
    yield ""
    if about:
        yield from (" ".join(about.split()), "")
    yield "| key | value | default | meaning |"
    yield "|---|---|---|---|"
    yield from _rows(node, _anchor_of(heading))
    yield ""
    if node.get("title") == _CLOTH:
        yield from _materials_of_cloth()


def _materials_of_cloth() -> Iterator[str]:
    """A table of what each material gives where its keys are omitted."""
    yield "What the materials give where a key is omitted:"
    yield ""
    yield f"| material | {' | '.join(f'`{key}` [{unit}]' for key, unit in MATERIAL_UNITS.items())} | what it is |"
    yield "|---" * (len(MATERIAL_UNITS) + 2) + "|"
    for material, numbers in MATERIALS.items():
        written = " | ".join(f"{numbers[key]:.5g}" for key in MATERIAL_UNITS)
        yield f'| "{material}" | {written} | {SOURCES[material]} |'
    yield ""


def _anchor_of(heading: str) -> str:
    """Begins the anchors of a table's keys: "fluid.block.", "cloth.shape.mesh.", "" at the top of the file."""
    words = re.findall(r"[a-z]\w*", heading) if heading.startswith("[") or "=" in heading else []
    return "".join(f"{word}." for word in words if word != "type")


def _rows(node: schema.Node, anchor: str) -> Iterator[str]:
    required = node.get("required", [])
    for key, property_ in node["properties"].items():
        table, _ = _table_of(key, property_)
        if table is not None or (key == "type" and "const" in property_):
            continue
        default = "required" if key in required else _written(property_.get("default"))
        if node.get("title") == _CLOTH and key in MATERIAL_UNITS:
            default = "the material's"
        name = f'<a id="{anchor}{key}" href="#{anchor}{key}">`{key}`</a>'
        cells = (name, _kind(property_), default, property_.get("description", ""))
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _kind(node: schema.Node) -> str:
    """What may be written there, in words."""
    if "anyOf" in node:
        options = [option for option in node["anyOf"] if option.get("type") != "null"]
        return " or ".join(_kind(option) for option in options)
    if "oneOf" in node:
        types = sorted(node["discriminator"]["mapping"])
        return f"{quoted_list(types)}, see below" if len(types) <= _MANY_TYPES else "a shape, see below"
    if "enum" in node:
        return quoted_list(node["enum"])
    if "const" in node:
        return f'"{node["const"]}"'
    if node["type"] == "array":
        prefix = node.get("prefixItems")
        return f"{len(prefix)} of: {_kind(prefix[0])}" if prefix else f"list of {_kind(node['items'])}"
    word = {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}[node["type"]]
    bounds = " and ".join(f"{sign} {node[key]:.10g}" for key, sign in _SIGNS.items() if key in node)
    return f"{word} {bounds}".strip()


def _written(default: Any) -> str:
    """A default as it would stand in TOML; what is left out by default has none."""
    if default is None:
        return "–"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    if isinstance(default, str):
        return f'`"{default}"`'
    if isinstance(default, list):
        return "`[" + ", ".join(_written(each).strip("`") for each in default) + "]`"
    return f"`{default:.6g}`" if isinstance(default, float) else f"`{default}`"


def main(arguments: list[str]) -> None:
    """Rewrite the reference in the given Markdown file."""
    path = Path(arguments[0])
    path.write_text(with_reference(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
