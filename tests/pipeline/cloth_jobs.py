"""Small jobs with a cloth, and what `check` tells of them."""

from pathlib import Path

from pipeline.job.checks import check_job
from pipeline.job.loading import LoadedJob, read_job
from pipeline.job.problems import Findings

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


def look_at(text: str, folder: Path, **options) -> tuple[LoadedJob, Findings]:
    path = folder / "drape.toml"
    path.write_text(text)
    loaded = read_job(path)
    return loaded, check_job(loaded.job, **options)


def errors(text: str, folder: Path, **options) -> list[str]:
    loaded, findings = look_at(text, folder, **options)
    return loaded.source.describe_all(findings.errors)


def warnings(text: str, folder: Path) -> list[str]:
    loaded, findings = look_at(text, folder)
    assert findings.errors == []
    return loaded.source.describe_all(findings.warnings)
