"""Results of a sweep: its pictures on one sheet with the values written in, and the solvers' numbers as one table."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.job.sweep import Variant
from pipeline.run.solver_numbers import simulation_numbers
from pipeline.show.picture_set import evenly_spread, picture_set
from render.sheet import contact_sheet, frame_label

CELL_WIDTH = 480
"""Of a picture on the sheet, at most [pixels]."""
PICTURES = 4
"""Of a job, side by side, where one key varies."""

Made = Sequence[tuple[Variant, JobLayout]]


def write_sheet(made: Made, path: Path) -> int:
    """Draw what the jobs of a sweep have rendered; returns how many of them are on it, and writes nothing for none.

    A row a job with pictures from all over its film; where two keys or more vary, one picture a job, from the middle of
    the film, in as many columns as the last key has values.
    """
    is_grid = bool(made) and len(made[0][0].values) > 1
    pictures: list[Path] = []
    labels: list[str] = []
    jobs = 0
    for variant, layout in made:
        frames = picture_set(load_job(layout.job_file), layout).all if layout.job_file.exists() else []
        if not frames:
            continue
        jobs += 1
        chosen = [frames[len(frames) // 2]] if is_grid else evenly_spread(frames, PICTURES)
        pictures += chosen
        labels += [variant.label if is_grid else f"{variant.label}\nframe {frame_label(each)}" for each in chosen]
    if pictures:
        columns = len({variant.values[-1] for variant, _ in made}) if is_grid else min(PICTURES, len(pictures) // jobs)
        contact_sheet(pictures, path, columns=columns, width=max(1, columns) * CELL_WIDTH, labels=labels)
    return jobs


def write_table(made: Made, path: Path) -> int:
    """Write the solvers' numbers of the jobs of a sweep as CSV, a line for each job and frame; returns how many lines.

    Columns are the job, the keys that vary, frame, time [s], and `SOLVER.NUMBER` in the units of `pipeline status`.

    Raises ManifestError: the record of a job cannot be read.
    """
    lines: list[dict[str, object]] = []
    for variant, layout in made:
        frames = simulation_numbers(layout, history=True).frames if layout.manifest.exists() else ()
        for frame in frames:
            numbers = {f"{solver}.{name}": value for solver, of in frame.solvers.items() for name, value in of.items()}
            head = {"job": layout.root.name, **dict(variant.values), "frame": frame.frame, "time_s": frame.time_s}
            lines.append({**head, **numbers})
    columns = list(dict.fromkeys(column for line in lines for column in line))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    if lines:
        replace_durably(path, text.getvalue())
    return len(lines)


def jobs_of_table(path: Path) -> set[str]:
    """Names of the jobs in a table that `write_table` wrote; none if there is no table."""
    if not path.exists():
        return set()
    with path.open(encoding="utf-8", newline="") as file:
        return {line.get("job") or "what is no job" for line in csv.DictReader(file)}
