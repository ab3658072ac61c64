"""Sweeps: a job for each combination of values of some keys, with a name that says which."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

from pipeline.base.errors import JobFileError
from pipeline.base.parameter_set import digest_of
from pipeline.model.job import Job

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


def variants(settings: Sequence[str], job: Job) -> list[Variant]:
    """Every combination of the values in settings `path.to.key=value,value` of a job, the last key changing fastest.

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
    return list(_combined(written, job))


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


def sweep_name(name: str, variant: Variant) -> str:
    """What the results of a job's sweep are called: `honey-viscosity-sweep`."""
    keys = [key for key, _ in variant.values]
    return f"{name}-{_cut('-'.join(map(_plain, keys)), always=not _are_plain(keys), by=repr(keys))}-sweep"


def _combined(written: Sequence[tuple[str, list[str]]], job: Job) -> Iterator[Variant]:
    varying = [key for key, values in written if len(values) > 1]
    short = _short_names(varying, job)
    suffixes = Counter[str]()
    for combination in product(*(values for _, values in written)):
        setting = dict(zip((key for key, _ in written), combination, strict=True))
        values = tuple((short[key], setting[key]) for key in varying)
        suffix = "-".join(f"{_plain(key)}-{_plain(value)}" for key, value in values)
        suffixes[suffix] += 1
        suffix = _cut(suffix, always=suffixes[suffix] > 1 or not _are_plain(varying), by=repr(values))
        yield Variant(values, tuple(f"{key}={value}" for key, value in setting.items()), suffix)


def _short_names(keys: Sequence[str], job: Job) -> dict[str, str]:
    """The fewest last parts of each key that tell it from the others, and from that key of the job's other bodies."""
    names = {}
    for key in keys:
        parts = key.split(".")
        tails = [".".join(parts[-count:]) for count in range(1, len(parts) + 1)]
        others = [other for other in (*keys, *_of_others(parts, job)) if other != key]
        names[key] = next(
            (tail for tail in tails if not any(other == tail or other.endswith(f".{tail}") for other in others)), key
        )
    return names


def _of_others(parts: Sequence[str], job: Job) -> list[str]:
    """The same key of the other bodies, materials, ... of the job."""
    table = getattr(job, parts[0], None)
    if len(parts) < 3 or not isinstance(table, dict | tuple):
        return []
    named = [str(getattr(each, "name", each)) for each in table]
    own = named[int(parts[1])] if parts[1].isdecimal() and int(parts[1]) < len(named) else parts[1]
    return [".".join((parts[0], name, *parts[2:])) for name in named if name != own]


def _cut(text: str, *, always: bool, by: str) -> str:
    """A text, with a digest of what it stands for where it is too long, or `always`."""
    if len(text) <= LONGEST_SUFFIX and not always:
        return text
    return f"{text[: LONGEST_SUFFIX - 9]}-{digest_of(by)[:8]}"


def _are_plain(keys: Sequence[str]) -> bool:
    """Whether names can say them with all their letters."""
    return all(_plain(key) == key for key in keys)


def _plain(text: str) -> str:
    """A text of letters that a name may have."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("_") or "_"
