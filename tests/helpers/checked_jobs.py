"""What `check` tells of the text of a job."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.job.loading import LoadedJob, read_job
from pipeline.model.problems import Findings
from pipeline.run import checked_job
from pipeline.run.checked_job import check_job, read_own_job

PLUME_FROM_A_BALL = """
name = "air"
frames = 24
fps = 24
[domain]
min = [-0.5, -0.5, 0.0]
max = [0.5, 0.5, 1.0]
[[smoke]]
name = "plume"
cell_size = 0.02
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""
"""Smoke in a box of a metre, without bodies: its lines are 2 to 14."""


BALL = """
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.1]
"""
WATER = """
[[fluid]]
name = "water"
particle_radius = 0.02
[[fluid.block]]
shape = { type = "box", size = [0.4, 0.4, 0.4] }
position = [0.0, 0.0, 0.5]
"""
PLUME = """
[[smoke]]
name = "plume"
cell_size = 0.05
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""


def says(line: str, expected: str) -> bool:
    """Whether a line begins with the first of the parts that "..." separates, and has the others after it in order."""
    return re.match(".*".join(map(re.escape, expected.split(" ... "))), line) is not None


class Checked(NamedTuple):
    """Lines as a user reads them, and what was found beside them."""

    errors: list[str]
    warnings: list[str]
    findings: Findings


def checked(text: str, path: Path, *, memory_bytes: int | None = None) -> Checked:
    """Write a job to a file and check it, on a machine with so much memory [bytes]."""
    path.write_text(text)
    loaded = read_job(path)
    findings = check_job(loaded.job, memory_bytes=memory_bytes)
    describe = loaded.source.describe_all
    return Checked(describe(findings.errors), describe(findings.warnings), findings)


def load_checked_job(
    path: Path, overrides: Sequence[str] = (), *, preview: bool = False, until: Sequence[str] = ()
) -> tuple[LoadedJob, Findings]:
    """Read and check a job as the commands do. Raises JobFileError with every problem."""
    return checked_job.checked(read_own_job(path, overrides, preview=preview, until=until), until)
