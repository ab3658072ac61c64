"""Problems of a job, and their places in the file."""

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count

from pipeline.model.positions import KeyPath, locate_keys

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_CLOSE_ENOUGH = 0.6
MOST_LISTED = 20
"""Names that a sentence lists."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One error or warning: the key it is about (empty for the whole job), and a sentence."""

    path: KeyPath
    message: str


@dataclass(slots=True)
class Findings:
    """Findings of the checks: problems in any order, what is good to know, and about how many elements there are."""

    errors: list[Problem] = field(default_factory=list)
    warnings: list[Problem] = field(default_factory=list)
    facts: list[Problem] = field(default_factory=list)
    elements: dict[str, int] = field(default_factory=dict)  # by kind of body

    def error(self, path: KeyPath, message: str) -> None:
        """Note a problem that forbids the job."""
        self.errors.append(Problem(path, message))

    def warn(self, path: KeyPath, message: str) -> None:
        """Note a problem that is worth a look."""
        self.warnings.append(Problem(path, message))


class JobSource:
    """Source of each key of a job: a line of the file, or the option that set it.

    Messages call the file by `name`; `text` is valid TOML; `options` has each key's option as it is spelled.
    """

    def __init__(self, name: str, text: str, options: Mapping[KeyPath, str] | None = None) -> None:
        self.name = name
        self.options = dict(options or {})
        self._text = text

    @cached_property
    def _lines(self) -> Mapping[KeyPath, int]:
        return locate_keys(self._text)

    def describe(self, problem: Problem) -> str:
        """One line: place, key, sentence."""
        place = self.place_of(problem.path)
        key = format_path(problem.path)
        return f"{place} {key}: {problem.message}" if key else f"{place}: {problem.message}"

    def describe_all(self, problems: Iterable[Problem]) -> list[str]:
        """A line for each, in the order of the file; what an option brought in comes first."""
        return [self.describe(problem) for problem in sorted(problems, key=self._line_of)]

    def _line_of(self, problem: Problem) -> int:
        line = self.place_of(problem.path).removeprefix(f"{self.name}:")
        return int(line) if line.isdecimal() else 0

    def place_of(self, path: KeyPath) -> str:
        """`dam.toml:12`, or the option that set this key; the nearest enclosing key's place if it stands nowhere."""
        for length in range(len(path), 0, -1):
            if option := self.options.get(path[:length]):
                return option
            if line := self._lines.get(path[:length]):
                return f"{self.name}:{line}"
        return self.name


def format_path(path: KeyPath) -> str:
    """A key path as people write it: `fluid[0].block[1].shape.size`."""
    written = ""
    for part in path:
        if isinstance(part, int):
            written += f"[{part}]"
        else:
            name = part if _BARE_KEY.fullmatch(part) else f'"{part}"'
            written += f".{name}" if written else name
    return written


def suggestion(word: object, known: Iterable[str]) -> str:
    """`; did you mean "viscosity"?` for the known word nearest to a misspelt one, or nothing."""
    candidates = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(str(word).lower(), list(candidates), n=1, cutoff=_CLOSE_ENOUGH)
    return f'; did you mean "{candidates[close[0]]}"?' if close else ""


def unknown_name(name: str, known: Iterable[str], kind: str, *, plural: str = "", none: str = "") -> str:
    """Sentence that no body of a kind has a name, with the names that may be meant, or what to do if there are none."""
    names = list(known)
    if f"{name}_1" in (taken := set(names)):
        last = next(number for number in count(1) if f"{name}_{number + 1}" not in taken)
        return f'"{name}" is a group of {last:,}; name one {kind} of it, "{name}_1" to "{name}_{last}"'
    few = names if len(names) <= MOST_LISTED else [*names[:MOST_LISTED], f"{len(names) - MOST_LISTED:,} more"]
    listed = f"; {plural or f'{kind}s'} are {', '.join(few)}" if names else none
    return f'no {kind} is named "{name}"{suggestion(name, names) or listed}'


def quoted_list(words: Iterable[str]) -> str:
    """`"a", "b" or "c"`."""
    quoted = [f'"{word}"' for word in words]
    if len(quoted) <= 1:
        return "".join(quoted)
    return f"{', '.join(quoted[:-1])} or {quoted[-1]}"
