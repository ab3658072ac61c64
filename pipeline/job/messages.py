"""Validation errors in the words of the person who wrote the job file."""

import json
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from pipeline.job import schema
from pipeline.model.job import NAME_PATTERN
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Problem, quoted_list, suggestion
from sim.core.parameters import KeyRefusedError

_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
_BOUNDS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}
_BODY_NAME_RULE = 'must begin with a letter and go on with letters, digits, "_" or "-", 64 at most'
_JOB_NAME_RULE = 'must begin with a letter or digit and go on with letters, digits, ".", "_" or "-", 100 at most'

_RENAMED: dict[KeyPath, str] = {("stage",): "[stage] is now [set]"}
"""Keys of earlier versions that have another name now."""


def explain(error: ValidationError, document: Mapping[str, Any]) -> list[Problem]:
    """Every error of a validation, in the order of the document's models, one problem a place."""
    places: dict[KeyPath, list[ErrorDetails]] = {}
    for details in error.errors(include_url=False):
        if not _is_consequence(details, document):
            places.setdefault(_written_path(details, document), []).append(details)
    problems: list[Problem] = []
    for path, errors in places.items():
        problem = _problem(path, errors, document)
        if problem not in problems:
            problems.append(problem)
    return problems


def _spelled(value: object) -> str:
    """A value as it looks in a message."""
    if isinstance(value, str):
        return f"the text {json.dumps(value, ensure_ascii=False)}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple):
        return "a list" if len(value) > 4 or any(isinstance(each, list | dict) for each in value) else str(value)
    return str(value)


def _value_at(document: Any, path: KeyPath) -> Any:
    for part in path:
        document = document[part]
    return document


def _written_path(details: ErrorDetails, document: object) -> KeyPath:
    """The error's location without the names of union members, which nobody wrote."""
    location = details["loc"]
    if details["type"] == "missing":
        location = location[:-1]  # the table or list that lacks it is what the user can see
    if details["type"] == "value_error" and isinstance(error := details["ctx"]["error"], KeyRefusedError):
        location = (*location, *error.path)
    path: KeyPath = ()
    for part in location:
        if isinstance(document, Mapping) and part in document:
            document = document[str(part)]
        elif isinstance(document, list) and isinstance(part, int) and part < len(document):
            document = document[part]
        else:
            continue
        path = (*path, part)
    return path


def _is_consequence(details: ErrorDetails, document: object) -> bool:
    """Whether the error merely follows from others: a list "too short" because its elements were refused."""
    if details["type"] != "too_short":
        return False
    return bool(_value_at(document, _written_path(details, document)))


def _problem(path: KeyPath, errors: list[ErrorDetails], document: Mapping[str, Any]) -> Problem:
    value = _value_at(document, path)
    missing = [key for each in errors if each["type"] == "missing" and isinstance(key := each["loc"][-1], str)]
    if missing:
        return Problem(path, _missing_keys(path, missing, value))
    broken_rules = [each for each in errors if each["type"] not in _EXPECTED and each["type"] != "literal_error"]
    if broken_rules:
        return Problem(path, _broken_rule(path, broken_rules[0], document))
    return Problem(path, _unexpected_value(path, errors, value))


def _missing_keys(path: KeyPath, missing: list[str], value: object) -> str:
    table = schema.node_at(path).narrowed(value)
    about = {key: table.child(key).description.rstrip(".") for key in missing}
    return "; ".join(f'missing key "{key}"' + (f" ({meaning})" if meaning else "") for key, meaning in about.items())


def _unexpected_value(path: KeyPath, errors: list[ErrorDetails], value: object) -> str:
    expected = dict.fromkeys(_EXPECTED.get(each["type"]) or _literals(each) for each in errors)
    sentence = f"expected {' or '.join(expected)}, got {_spelled(value)}"
    if schema.node_at(path).is_array_of_tables and isinstance(value, Mapping):
        return f"{sentence}; write [[{'.'.join(str(part) for part in path if isinstance(part, str))}]], in two brackets"
    choices = [word for each in errors if each["type"] == "literal_error" for word in _words(each, "expected")]
    return sentence + (suggestion(value, choices) if isinstance(value, str) else "")


def _literals(details: ErrorDetails) -> str:
    words = _words(details, "expected")
    return quoted_list(words) if "'" in details["ctx"]["expected"] else " or ".join(words)


def _words(details: ErrorDetails, key: str) -> list[str]:
    """Choices that an error lists as `'a', 'b' or 'c'`."""
    return [word.strip("'") for word in details["ctx"][key].replace(" or ", ", ").split(", ")]


def _broken_rule(path: KeyPath, details: ErrorDetails, document: Mapping[str, Any]) -> str:
    value = _value_at(document, path)
    if details["type"] == "extra_forbidden":
        return _unknown_key(path, _value_at(document, path[:-1]))
    rule = _RULES.get(details["type"])
    if rule is None:
        return f"{details['msg'][:1].lower()}{details['msg'][1:]}, got {_spelled(value)}"
    return rule(path, details, value)


def _out_of_bounds(path: KeyPath, details: ErrorDetails, value: object) -> str:
    sign, key = _BOUNDS[details["type"]]
    bound = f"{details['ctx'][key]:.10g} {schema.node_at(path).unit}".rstrip()
    return f"must be {sign} {bound}, got {_spelled(value)}"


def _wrong_length(path: KeyPath, details: ErrorDetails, value: object) -> str:
    got = len(value) if isinstance(value, list) else 0
    if details["type"] == "missing":  # a vector that lacks its last elements
        length = max(len(alternative.get("prefixItems", [])) for alternative in schema.node_at(path).alternatives)
        return f"expected {length} values, got {got}"
    if details["type"] == "too_short":
        return f"must hold at least {details['ctx']['min_length']}, got {got}"
    return f"expected {details['ctx']['max_length']} values, got {got}"


def _unknown_key(path: KeyPath, table: object) -> str:
    if path in _RENAMED:
        return _RENAMED[path]
    key, known = str(path[-1]), schema.node_at(path[:-1]).narrowed(table).keys
    sentence = f'unknown key "{key}"'
    if near := suggestion(key, known):
        return sentence + near
    if len(path) > 1 and key in schema.root().keys:
        return f"{sentence}; it belongs to the top of the file, above the first [table]"
    homes = [name for name, section in schema.sections() if key in section.keys and name != path[0]]
    if homes:
        return f"{sentence}; it belongs to {' or '.join(f'[{home}]' for home in homes)}"
    return f"{sentence}; known here: {', '.join(known)}" if known else sentence


def _unknown_type(_path: KeyPath, details: ErrorDetails, _value: object) -> str:
    known = _words(details, "expected_tags")
    tag = details["ctx"]["tag"]
    return f'unknown type "{tag}", types are {", ".join(known)}{suggestion(tag, known)}'


def _no_type(path: KeyPath, _details: ErrorDetails, _value: object) -> str:
    # What may be left out may be null as well, which has no type.
    alternatives = schema.node_at(path).alternatives
    known = [each["properties"]["type"]["const"] for each in alternatives if "properties" in each]
    return f'missing key "type"; types are {", ".join(known)}'


def _wrong_pattern(_path: KeyPath, details: ErrorDetails, value: object) -> str:
    rule = _JOB_NAME_RULE if details["ctx"]["pattern"] == NAME_PATTERN else _BODY_NAME_RULE
    return f"{rule}, got {_spelled(value)}"


_RULES: dict[str, Callable[[KeyPath, ErrorDetails, object], str]] = {
    **dict.fromkeys(_BOUNDS, _out_of_bounds),
    "missing": _wrong_length,
    "too_short": _wrong_length,
    "too_long": _wrong_length,
    "union_tag_invalid": _unknown_type,
    "union_tag_not_found": _no_type,
    "string_pattern_mismatch": _wrong_pattern,
    "string_too_short": lambda _path, _details, _value: "must not be empty",
    "finite_number": lambda _path, _details, value: f"must be finite, got {_spelled(value)}",
    "value_error": lambda _path, details, _value: str(details["ctx"]["error"]),
}
