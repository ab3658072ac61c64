"""The goal of a job: the stages after which it ends, as its last submission wanted it; none for the whole film.

It lies in the job's folder, so that what is asked of the job later (status, resume, rerun) goes by it, too.
"""

import json
from collections.abc import Sequence

from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout


def read_goal(layout: JobLayout) -> tuple[str, ...]:
    """The stages after which a job ends; empty for the film, and of a file that is none."""
    try:
        stages = json.loads(layout.goal.read_text(encoding="utf-8"))["until"]
    except (FileNotFoundError, ValueError, TypeError, KeyError):
        return ()
    return tuple(str(stage) for stage in stages) if isinstance(stages, list) else ()


def write_goal(layout: JobLayout, until: Sequence[str]) -> None:
    """Keep a job's goal; durably, as a resumed job would else make more than was wanted."""
    if tuple(until) == read_goal(layout):
        return
    if until:
        replace_durably(layout.goal, json.dumps({"until": [*until]}) + "\n")
    else:
        layout.goal.unlink(missing_ok=True)


def what_is_made(layout: JobLayout) -> str:
    """What a job is to make, for a message: its film, or its folder and the stages after which it ends."""
    until = read_goal(layout)
    return f"{layout.root} (until {', '.join(until)})" if until else str(layout.film)
