"""The goal of a job: the stages after which it ends, as its last submission wanted it; none for the whole film.

It lies in the job's folder, so that what is asked of the job later (status, resume, rerun) goes by it, too.
"""

import json
from collections.abc import Sequence

from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.stages import STAGES


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


def own_goal(layout: JobLayout) -> tuple[str, ...]:
    """The goal but for exports, which are made beside it."""
    on_demand = {stage.name for stage in STAGES if stage.on_demand}
    return tuple(end for end in read_goal(layout) if end.partition(":")[0] not in on_demand)


def return_to(layout: JobLayout, before: Sequence[str]) -> None:
    """After an export is made, let what is asked of the job be about its own goal again, as it was before."""
    if read_goal(layout) != own_goal(layout):
        write_goal(layout, before)


def what_is_made(layout: JobLayout) -> str:
    """What a job is to make, for a message: its film, or its folder and the stages after which it ends."""
    until = read_goal(layout)
    return f"{layout.root} (until {', '.join(until)})" if until else str(layout.film)
