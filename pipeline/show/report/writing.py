"""From jobs' folders to a report on the disk."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from pipeline.base import wording
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.show.report.job_report import gather
from pipeline.show.report.page import page


def write_report(layouts: Sequence[JobLayout], path: Path) -> None:
    """Write the report of a job, or of several in comparison, as one HTML file.

    Args:
        layouts: folders of submitted jobs.
        path: the file; replaced if it is there.

    Raises:
        PipelineError: a job cannot be read.
        OSError: the file cannot be written.
    """
    names = [load_job(layout.job_file).name for layout in layouts]
    titles = [str(layout.root) if names.count(name) > 1 else name for layout, name in zip(layouts, names, strict=True)]
    reports = [gather(layout, title=title) for layout, title in zip(layouts, titles, strict=True)]
    replace_durably(path, page(reports, written=f"Report of {wording.moment(time.time())}"))
