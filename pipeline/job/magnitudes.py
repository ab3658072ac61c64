"""Numbers that no film can mean, told before they overflow something."""

from collections.abc import Iterator
from typing import Any

from pipeline.job import schema
from pipeline.kinds.table import KINDS
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings

# A micrometre to a thousand kilometres [m].
SMALLEST_LENGTH, LARGEST_LENGTH = 1.0e-6, 1.0e6
# Of any other kind, in SI units.
LARGEST_NUMBER = 1.0e9


def check_magnitudes(job: Job, findings: Findings) -> bool:
    """Whether every number of the scene is of a size that can be computed with; notes those that are not."""
    ok = True
    scene = job.model_dump(include={"domain", "gravity", *KINDS, "whitewater"}, exclude_defaults=True)
    for path, value in _numbers(scene):
        if value == 0.0 or SMALLEST_LENGTH <= abs(value) <= LARGEST_LENGTH:
            continue  # fits whatever the unit; to ask for that, the schema of all jobs is built, which takes a while
        node = schema.node_at(path)
        largest = LARGEST_LENGTH if node.unit == "m" else LARGEST_NUMBER
        if abs(value) > largest:
            bound = f"{largest:g} {node.unit}".rstrip()
            findings.error(path, f"must be within ±{bound}, got {value:g}; units are SI")
            ok = False
        elif node.unit == "m" and node.is_positive and value < SMALLEST_LENGTH:
            findings.error(path, f"must be at least {SMALLEST_LENGTH:g} m, got {value:g}; units are SI")
            ok = False
    return ok


def _numbers(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, float]]:
    if isinstance(value, dict):
        for key, child in value.items():
            yield from _numbers(child, (*path, key))
    elif isinstance(value, list | tuple):
        for index, child in enumerate(value):
            yield from _numbers(child, (*path, index))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)
