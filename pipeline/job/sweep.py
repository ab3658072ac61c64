"""Sweeps: a job for each combination of values of some keys, with a name that says which."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

from pipeline.base.errors import JobFileError
from pipeline.base.parameter_set import digest_of

MOST_JOBS = 1000
"""Nobody means a larger grid."""
LONGEST_SUFFIX = 60
"""Of a job's name; longer ones end in a digest."""
_OPENING, _CLOSING = "[{", "]}"


@dataclass(frozen=True)
class Variant:
    """A job of a sweep."""

    values: tuple[tuple[str, str], ...]  # the keys that vary, each with its value as written
    overrides: tuple[str, ...]  # all of `--set`, those of keys that do not vary included
    suffix: str  # what its name has after that of the sweep

    @property
    def label(self) -> str:
        """`viscosity = 0.1`, a line for each key."""
        return "\n".join(f"{key} = {value}" for key, value in self.values)


def variants(settings: Sequence[str]) -> list[Variant]:
    """Every combination of the values in settings `path.to.key=value,value`, the last key changing fastest.

    Commas between brackets and in quotes are part of a value: `camera.position=[0,-2,1],[0,-3,1]` is two. A key with
    one value is the same in all jobs.

    Raises JobFileError: a setting has no value, a key is there twice, or nothing varies; names all.
    """
    problems, written = [], list[tuple[str, list[str]]]()
    for setting in settings:
        key, equals, text = setting.partition("=")
        values = split_values(text)
        if not equals or not key.strip() or "" in values:
            problems.append(f"--set {setting}: expected path.to.key=value,value,...")
            continue
        written.append((key.strip(), list(dict.fromkeys(values))))
    if any(key == "name" for key, _ in written):
        problems.append("--set name: the jobs of a sweep are called by their values; leave it out")
    counts = Counter(key for key, _ in written)
    problems += [
        f"--set {key}: is there {count} times; give all its values at once"
        for key, count in counts.items()
        if count > 1
    ]
    if not problems and all(len(values) == 1 for _, values in written):
        problems.append("nothing varies: give a key several values, as in --set 'fluid.water.viscosity=0.01,0.1,1'")
    total = 1
    for _, values in written:
        total *= len(values)
    if total > MOST_JOBS:
        problems.append(f"{total:,} jobs are more than {MOST_JOBS:,}; give fewer values")
    if problems:
        raise JobFileError(problems)
    return list(_combined(written))


def split_values(text: str) -> list[str]:
    """The values in a text, cut at its commas that are neither between brackets nor in quotes."""
    pieces, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in _OPENING:
            depth += 1
        elif letter in _CLOSING:
            depth -= 1
        elif letter == "," and depth <= 0:
            pieces.append("")
            continue
        pieces[-1] += letter
    return [piece.strip() for piece in pieces]


def _combined(written: Sequence[tuple[str, list[str]]]) -> Iterator[Variant]:
    varying = [key for key, values in written if len(values) > 1]
    short = _short_names(varying)
    suffixes = Counter[str]()
    for combination in product(*(values for _, values in written)):
        setting = dict(zip((key for key, _ in written), combination, strict=True))
        values = tuple((short[key], setting[key]) for key in varying)
        suffix = "-".join(f"{_plain(key)}-{_plain(value)}" for key, value in values)
        suffixes[suffix] += 1
        if len(suffix) > LONGEST_SUFFIX or suffixes[suffix] > 1:
            suffix = f"{suffix[: LONGEST_SUFFIX - 9]}-{digest_of(repr(values))[:8]}"
        yield Variant(values, tuple(f"{key}={value}" for key, value in setting.items()), suffix)


def _short_names(keys: Sequence[str]) -> dict[str, str]:
    """The fewest last parts of each key that tell it from the others."""
    names = {}
    for key in keys:
        parts = key.split(".")
        tails = [".".join(parts[-count:]) for count in range(1, len(parts) + 1)]
        others = [other for other in keys if other != key]
        names[key] = next(
            (tail for tail in tails if not any(other == tail or other.endswith(f".{tail}") for other in others)), key
        )
    return names


def _plain(text: str) -> str:
    """A text of letters that a name may have."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("_") or "_"
