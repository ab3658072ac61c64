"""The line of every key of a TOML text, which neither `tomllib` nor `tomlkit` tells.

The scanner reads TOML that `tomllib` has accepted already, so it need not diagnose anything.
"""

import re
from collections.abc import Iterator, Mapping
from itertools import count

KeyPath = tuple[str | int, ...]
"""Keys and array indices from the top of the document, e.g. `("fluid", 0, "rest_density")`."""

_BLANK = re.compile(r"[ \t]+")
_BLANK_LINES_AND_COMMENTS = re.compile(r"(?:[ \t\r\n]+|#[^\n]*)+")
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}'  # up to two quotes may precede the closing delimiter
    r"|'''.*?'{3,5}"
    r'|"(?:[^"\\\n]|\\.)*"'
    r"|'[^'\n]*'",
    re.DOTALL,
)
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE_VALUE = re.compile(r"[^,\]}#\n]*")
_ESCAPE = re.compile(r"\\(?:u([0-9A-Fa-f]{4})|U([0-9A-Fa-f]{8})|(.))")
_ESCAPED = {"b": "\b", "t": "\t", "n": "\n", "f": "\f", "r": "\r", "e": "\x1b"}


def locate_keys(text: str) -> Mapping[KeyPath, int]:
    """Line, counted from 1, of every table, key and array element of a valid TOML document."""
    return _Scanner(text).scan_document()


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._lines: dict[KeyPath, int] = {}
        self._last_offset, self._last_line = 0, 1
        self._tables_in_array: dict[KeyPath, int] = {}

    def scan_document(self) -> Mapping[KeyPath, int]:
        table: KeyPath = ()
        self._skip(_BLANK_LINES_AND_COMMENTS)
        while self._at < len(self._text):
            if self._take("[["):
                table = self._enter_table(self._key_parts(), in_array=True)
                self._take("]]")
            elif self._take("["):
                table = self._enter_table(self._key_parts(), in_array=False)
                self._take("]")
            else:
                self._scan_pair(table)
            self._skip(_BLANK_LINES_AND_COMMENTS)
        return self._lines

    def _enter_table(self, parts: list[str], *, in_array: bool) -> KeyPath:
        path: KeyPath = ()
        for part in parts[:-1]:
            path = self._last_table((*path, part))
        path = (*path, parts[-1])
        if in_array:
            self._tables_in_array[path] = self._tables_in_array.get(path, 0) + 1
        path = self._last_table(path)
        self._record(path)
        return path

    def _last_table(self, path: KeyPath) -> KeyPath:
        """`path` itself, or the newest table of the array of tables at `path`."""
        self._record(path)
        tables = self._tables_in_array.get(path, 0)
        return (*path, tables - 1) if tables else path

    def _scan_pair(self, table: KeyPath) -> None:
        path = table
        for part in self._key_parts():
            path = (*path, part)
            self._record(path)
        self._take("=")
        self._skip(_BLANK)
        self._scan_value(path)

    def _scan_value(self, path: KeyPath) -> None:
        if self._take("["):
            for index in self._items_until("]"):
                self._record((*path, index))
                self._scan_value((*path, index))
        elif self._take("{"):
            for _ in self._items_until("}"):
                self._scan_pair(path)
        elif not self._skip(_STRING):
            self._skip(_BARE_VALUE)

    def _items_until(self, end: str) -> Iterator[int]:
        """Numbers of the items of an array or an inline table, each of which the caller scans."""
        self._skip(_BLANK_LINES_AND_COMMENTS)
        for index in count():
            if self._take(end):
                return
            yield index
            self._skip(_BLANK_LINES_AND_COMMENTS)
            self._take(",")
            self._skip(_BLANK_LINES_AND_COMMENTS)

    def _key_parts(self) -> list[str]:
        parts: list[str] = []
        while not parts or self._take("."):
            self._skip(_BLANK)
            quoted = _STRING.match(self._text, self._at)
            match = quoted or _BARE_KEY.match(self._text, self._at)
            if match is None:
                raise ValueError(f"not TOML at offset {self._at}")
            self._at = match.end()
            parts.append(_unquote(match.group()) if quoted else match.group())
            self._skip(_BLANK)
        return parts

    def _take(self, token: str) -> bool:
        if self._text.startswith(token, self._at):
            self._at += len(token)
            return True
        return False

    def _skip(self, pattern: re.Pattern[str]) -> bool:
        match = pattern.match(self._text, self._at)
        if match is None:
            return False
        self._at = match.end()
        return True

    def _record(self, path: KeyPath) -> None:
        self._last_line += self._text.count("\n", self._last_offset, self._at)
        self._last_offset = self._at
        self._lines.setdefault(path, self._last_line)


def _unquote(key: str) -> str:
    if key.startswith("'"):
        return key[1:-1]
    return _ESCAPE.sub(
        lambda match: chr(int(match[1] or match[2], 16)) if match[3] is None else _ESCAPED.get(match[3], match[3]),
        key[1:-1],
    )
