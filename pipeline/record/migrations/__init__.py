"""The manifest's schema, as numbered migrations. A released one is never edited: a change is a new file."""

import re
import sqlite3
from functools import cache
from importlib.resources import files

from pipeline.base.errors import ManifestError

_NAME = re.compile(r"^(\d{4})_\w+\.sql$")


@cache
def migrations() -> tuple[str, ...]:
    """The scripts in order; script n (from 1) makes schema version n of version n - 1."""
    scripts = {int(match[1]): item for item in files(__name__).iterdir() if (match := _NAME.match(item.name))}
    return tuple(scripts[number].read_text() for number in range(1, len(scripts) + 1))


def schema_version(connection: sqlite3.Connection) -> int:
    """Version of the schema that a manifest has; 0 for a new file."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def migrate(connection: sqlite3.Connection) -> None:
    """Bring a manifest to the newest schema, each step in a transaction of its own.

    Raises ManifestError: it was written by a newer program.
    """
    version = schema_version(connection)
    refuse_newer(version)
    for number, script in enumerate(migrations()[version:], start=version + 1):
        try:
            connection.executescript(f"BEGIN IMMEDIATE;\n{script}\nPRAGMA user_version = {number};\nCOMMIT;")
        finally:
            if connection.in_transaction:
                connection.rollback()


def refuse_newer(version: int) -> None:
    """Raise ManifestError if a manifest of this schema version is of a newer program."""
    if version > len(migrations()):
        raise ManifestError(
            f"the manifest has schema version {version}, and this program knows {len(migrations())}: "
            "use the newer program that wrote it"
        )
