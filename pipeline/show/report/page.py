"""The report's page: HTML with its style, charts, pictures and numbers inside."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from pipeline.base import wording
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.show.report.chart import line_chart, swatch
from pipeline.show.report.job_report import JobReport, gather
from pipeline.show.report.job_section import job_section, origins_section
from pipeline.show.report.panels import Panel, panels_of


def write_report(layouts: Sequence[JobLayout], path: Path) -> None:
    """Write the report of a submitted job, or of several in comparison, as one HTML file.

    Raises:
        PipelineError: a job cannot be read.
        OSError: the file cannot be written.
    """
    names = [load_job(layout.job_file).name for layout in layouts]
    titles = [str(layout.root) if names.count(name) > 1 else name for layout, name in zip(layouts, names, strict=True)]
    reports = [gather(layout, title=title) for layout, title in zip(layouts, titles, strict=True)]
    replace_durably(path, page(reports, written=f"Report of {wording.moment(time.time())}"))


def page(reports: Sequence[JobReport], *, written: str) -> str:
    """The page of one job, or of several in the same charts."""
    title, several = " and ".join(report.title for report in reports), len(reports) > 1
    found = panels_of([report.numbers for report in reports])
    sections = [_section("Solvers in comparison" if several else "Solvers", _charts(found.panels, found.zero))]
    if several:
        sections.insert(0, _section("Energy kept", _energies(reports)))
    body = [
        f"<header><h1>{escape(title)}</h1><p>{escape(written)}</p></header>",
        *(job_section(report, headed=several) for report in reports),
        *sections,
        _section("What it was made of", "".join(origins_section(each, headed=several) for each in reports)),
    ]
    style = files(__package__).joinpath("report.css").read_text(encoding="utf-8")
    data = _json({"written": written, "jobs": [report.as_json() for report in reports]})
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{style}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + f'\n<script type="application/json" id="numbers">{data}</script>\n</body>\n</html>\n'
    )


def _energies(reports: Sequence[JobReport]) -> str:
    """What became of the mechanical energy of each job, from its first frame to its last."""
    rows = []
    for report in reports:
        energies = [energy for energy in report.numbers.total_energy() if math.isfinite(energy)]
        if energies:
            first, last = energies[0], energies[-1]
            rows.append(
                f"<tr><th>{escape(report.title)}</th><td>{first:.5g} J</td><td>{last:.5g} J</td>"
                f"<td>{first - last:.5g} J</td></tr>"
            )
    if not rows:
        return '<p class="quiet">No solver tells its mechanical energy.</p>'
    head = "<th>job</th><th>first frame</th><th>last frame</th><th>lost</th>"
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        '<p class="quiet">Kinetic, potential and elastic energy of all bodies. Particles and bodies that leave the '
        "domain take theirs along.</p>"
    )


def _charts(panels: Iterable[Panel], zero: Sequence[str]) -> str:
    figures = "".join(_figure(panel) for panel in panels)
    if not figures:
        return '<p class="quiet">No frame has been simulated yet.</p>'
    note = f'<p class="quiet">Zero in every frame: {escape("; ".join(zero))}.</p>' if zero else ""
    return f'<div class="charts">{figures}</div>{note}'


def _figure(panel: Panel) -> str:
    unit = f" [{panel.unit}]" if panel.unit else ""
    legend = "".join(f"<li>{swatch(line)}{escape(line.label)}</li>" for line in panel.lines)
    chart = line_chart(panel.lines, x_label="simulated time [s]", may_be_logarithmic=panel.logarithmic)
    return f"<figure><figcaption>{escape(panel.title + unit)}</figcaption><ul>{legend}</ul>{chart}</figure>"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _json(data: object) -> str:
    """JSON that may stand in a script element: no markup in it, and null for numbers that are not finite."""
    text = json.dumps(_finite(data), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _finite(data: object) -> object:
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data
