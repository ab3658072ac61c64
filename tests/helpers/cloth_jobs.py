"""Small jobs with a cloth, and what `check` tells of them."""

from pathlib import Path

from checked_jobs import checked

SHEET = """\
name = "drape"
[domain]
open_faces = ["x-", "x+", "y-", "y+", "z+"]
[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [0.4, 0.4], counts = [9, 9] }
position = [0.0, 0.0, 0.5]
"""
BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.3]
"""


def errors(text: str, folder: Path, **options) -> list[str]:
    return checked(text, folder / "drape.toml", **options).errors


def warnings(text: str, folder: Path) -> list[str]:
    found = checked(text, folder / "drape.toml")
    assert found.errors == []
    return found.warnings
