"""The line of every key of a TOML text.

`tomllib` gives values without positions and `tomlkit` keeps formatting but no line numbers, while an error is only
half as useful without its line. This scanner reads TOML that `tomllib` has accepted already, so it need not diagnose
anything: it walks the text once and writes down where each key and each array element starts.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

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
    scanner = _Scanner(text)
    scanner.scan_document()
    return scanner.lines


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.lines: dict[KeyPath, int] = {}
        self._last_offset, self._last_line = 0, 1
        self._tables_in_array: dict[KeyPath, int] = {}

    def scan_document(self) -> None:
        table: KeyPath = ()
        self._skip(_BLANK_LINES_AND_COMMENTS)
        while self.at < len(self.text):
            if self._take("[["):
                table = self._enter_table(self._key_parts(), in_array=True)
                self._take("]]")
            elif self._take("["):
                table = self._enter_table(self._key_parts(), in_array=False)
                self._take("]")
            else:
                self._scan_pair(table)
            self._skip(_BLANK_LINES_AND_COMMENTS)

    def _enter_table(self, parts: list[str], *, in_array: bool) -> KeyPath:
        path: KeyPath = ()
        for part in parts[:-1]:
            path = self._last_table((*path, part))
        path = (*path, parts[-1])
        if not in_array:
            path = self._last_table(path)
        else:
            self._record(path)
            self._tables_in_array[path] = self._tables_in_array.get(path, 0) + 1
            path = self._last_table(path)
        self._record(path)
        return path

    def _last_table(self, path: KeyPath) -> KeyPath:
        """`path` itself, or the newest table of the array of tables at `path`."""
        self._record(path)
        count = self._tables_in_array.get(path, 0)
        return (*path, count - 1) if count else path

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
            self._scan_array(path)
        elif self._take("{"):
            self._scan_inline_table(path)
        elif not self._skip(_STRING):
            self._skip(_BARE_VALUE)

    def _scan_array(self, path: KeyPath) -> None:
        index = 0
        self._skip(_BLANK_LINES_AND_COMMENTS)
        while not self._take("]"):
            self._record((*path, index))
            self._scan_value((*path, index))
            index += 1
            self._skip(_BLANK_LINES_AND_COMMENTS)
            self._take(",")
            self._skip(_BLANK_LINES_AND_COMMENTS)

    def _scan_inline_table(self, path: KeyPath) -> None:
        self._skip(_BLANK_LINES_AND_COMMENTS)
        while not self._take("}"):
            self._scan_pair(path)
            self._skip(_BLANK_LINES_AND_COMMENTS)
            self._take(",")
            self._skip(_BLANK_LINES_AND_COMMENTS)

    def _key_parts(self) -> list[str]:
        parts: list[str] = []
        while not parts or self._take("."):
            self._skip(_BLANK)
            quoted = _STRING.match(self.text, self.at)
            match = quoted or _BARE_KEY.match(self.text, self.at)
            if match is None:
                raise ValueError(f"not TOML at offset {self.at}")
            self.at = match.end()
            parts.append(_unquote(match.group()) if quoted else match.group())
            self._skip(_BLANK)
        return parts

    def _take(self, token: str) -> bool:
        if self.text.startswith(token, self.at):
            self.at += len(token)
            return True
        return False

    def _skip(self, pattern: re.Pattern[str]) -> bool:
        match = pattern.match(self.text, self.at)
        if match is None:
            return False
        self.at = match.end()
        return True

    def _record(self, path: KeyPath) -> None:
        self._last_line += self.text.count("\n", self._last_offset, self.at)
        self._last_offset = self.at
        self.lines.setdefault(path, self._last_line)


def _unquote(key: str) -> str:
    if key.startswith("'"):
        return key[1:-1]
    return _ESCAPE.sub(
        lambda match: chr(int(match[1] or match[2], 16)) if match[3] is None else _ESCAPED.get(match[3], match[3]),
        key[1:-1],
    )
