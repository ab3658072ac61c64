"""The report's page: HTML with its style, charts, pictures and numbers inside, a section for each job."""

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
from pipeline.record.reader import StageTiming
from pipeline.run.plan import frame_ranges
from pipeline.run.solver_numbers import unreadable_whitewater
from pipeline.show.report.chart import chart, scripts, style
from pipeline.show.report.film import ReportFilm, as_address
from pipeline.show.report.job_report import JobReport, MadeWith, gather
from pipeline.show.report.panels import Panel, panels_of

TIME = "simulated time [s]"
HANDLING = (
    "A drag zooms all charts, a double click shows all again; a click on a name hides its line."
    "<noscript> Charts need JavaScript, which is off here; their numbers are in this file.</noscript>"
)


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
    looks = style() + files(__package__).joinpath("report.css").read_text(encoding="utf-8")
    charts = [chart(each.lines, x_label=TIME, may_be_logarithmic=each.logarithmic) for each in found.panels]
    uplot, drawing = scripts()
    data = _json({"written": written, "jobs": [report.as_json() for report in reports]})
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{looks}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + f'\n<script type="application/json" id="numbers">{data}</script>\n'
        + f'<script type="application/json" id="charts">{_json(charts)}</script>\n'
        + f"<script>{uplot}</script>\n<script>{drawing}</script>\n</body>\n</html>\n"
    )


def _energies(reports: Sequence[JobReport]) -> str:
    """What became of the mechanical energy of each job, from its first frame to its last."""
    rows = []
    for report in reports:
        energies = [energy for energy in report.numbers.total_energy() if math.isfinite(energy)]
        if energies:
            first, last = energies[0], energies[-1]
            numbers = "".join(f"<td>{number:.5g} J</td>" for number in (first, last, first - last))
            rows.append(f"<th>{escape(report.title)}</th>{numbers}")
    if not rows:
        return '<p class="quiet">No solver tells its mechanical energy.</p>'
    return (
        f"{_table(('job', 'first frame', 'last frame', 'lost'), rows)}"
        '<p class="quiet">Kinetic, potential and elastic energy of all bodies. Particles and bodies that leave the '
        "domain take theirs along.</p>"
    )


def _charts(panels: Iterable[Panel], zero: Sequence[str]) -> str:
    figures = "".join(f"<figure><figcaption>{escape(_titled(panel))}</figcaption></figure>" for panel in panels)
    if not figures:
        return '<p class="quiet">No frame has been simulated yet.</p>'
    note = f'<p class="quiet">Zero in every frame: {escape("; ".join(zero))}.</p>' if zero else ""
    return f'<p class="quiet">{HANDLING}</p><div class="charts">{figures}</div>{note}'


def _titled(panel: Panel) -> str:
    return f"{panel.title} [{panel.unit}]" if panel.unit else panel.title


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _table(names: Iterable[str], rows: Iterable[str], *, kind: str = "") -> str:
    """A table, as wide as the page at most, of a heading and rows."""
    head = "".join(f"<th>{name}</th>" for name in names)
    mark = f' class="{kind}"' if kind else ""
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f'<div class="wide"><table{mark}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


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


# --- one job ---

LEAST_SHARE = 0.07  # of all time: what a stage must have taken to have its name on the bar


def job_section(report: JobReport, *, headed: bool) -> str:
    """All about a job but the charts, which jobs share; below its name (`headed`) where there are several."""
    facts = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in report.facts.items())
    told = f"<dl>{facts}</dl>{_warnings(report)}"
    film = "" if report.film is None else _film(report.film, report.title)
    parts = [f'<div class="head">{film}<div>{told}</div></div>' if film else told]
    if headed:
        parts.insert(0, f"<h2>{escape(report.title)}</h2>")
    if report.timings:
        parts += ["<h3>Where the time went</h3>", _shares(report.timings), _timings(report.timings)]
    if report.sheet is not None or report.sheet_remark:
        parts.append("<h3>Frames</h3>")
    if report.sheet is not None:
        parts.append(
            f'<img class="sheet" src="{as_address(report.sheet, "image/webp")}" alt="frames of {escape(report.title)}">'
        )
    if report.sheet_remark:
        parts.append(f'<p class="quiet">{escape(report.sheet_remark)}</p>')
    return f"<section>{''.join(parts)}</section>"


def origins_section(report: JobReport, *, headed: bool) -> str:
    """What the job was made with, and its text; folded together."""
    name = f" of {escape(report.title)}" if headed else ""
    versions = f"<details><summary>Versions{name}</summary>{_versions(report.versions)}</details>"
    text = f"<details><summary>Job file{name}</summary><pre>{escape(report.text)}</pre></details>"
    return (versions if report.versions else "") + text


def _film(film: ReportFilm, title: str) -> str:
    size = f'width="{film.width}" height="{film.height}"'
    address = as_address(film.content, film.mime)
    if film.mime.startswith("video/"):
        shown = f'<video class="film" controls loop muted playsinline {size} src="{address}"></video>'
    else:
        shown = f'<img class="film" {size} src="{address}" alt="film of {escape(title)}">'
    remark = f'<p class="quiet">{escape(film.remark)}</p>' if film.remark else ""
    return f"<div>{shown}{remark}</div>"


def _shares(timings: Sequence[StageTiming]) -> str:
    """The time of all stages as one bar."""
    total = sum(timing.seconds for timing in timings) or 1.0
    pieces = "".join(
        f'<span class="b{index % 8}" style="flex-grow:{timing.seconds / total:.4f}" '
        f'title="{escape(timing.stage)}: {wording.duration(timing.seconds)}">'
        + (f"{escape(timing.stage)} {100.0 * timing.seconds / total:.0f} %" if timing.seconds >= named else "")
        + "</span>"
        for index, timing in enumerate(timings)
        if timing.seconds > 0.0
        for named in (LEAST_SHARE * total,)
    )
    whole = f"{wording.duration(sum(timing.seconds for timing in timings))} of work"
    return f'<div class="shares">{pieces}</div><p class="quiet">{whole}; stages may have worked beside each other.</p>'


def _warnings(report: JobReport) -> str:
    sentences = [*map(str, report.warnings), *wording.mixed_devices(report.drawn_on)]
    if report.unreadable:
        frames = frame_ranges(report.unreadable, range(report.unreadable[-1] + 1))
        sentences.append(f"frames of the cache that cannot be read: {frames}")
    sentences += unreadable_whitewater(report.unreadable_whitewater)
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f'<ul class="warnings">{items}</ul>' if items else '<p class="quiet">No warnings.</p>'


def _timings(timings: Sequence[StageTiming]) -> str:
    most = max(timing.seconds for timing in timings) or 1.0
    rows = (
        f"<th>{escape(timing.stage)}</th><td>{timing.attempts:,}</td><td>{timing.failed:,}</td>"
        f'<td class="bar"><span style="width:{100.0 * timing.seconds / most:.1f}%"></span>'
        f"{wording.duration(timing.seconds)}</td><td>{wording.duration(timing.longest_s)}</td>"
        f"<td>{wording.size(timing.peak_memory_bytes) if timing.peak_memory_bytes else '–'}</td>"
        f"<td>{timing.artifacts:,}</td><td>{wording.size(timing.bytes)}</td>"
        for timing in timings
    )
    names = ("stage", "attempts", "failed", "time of all", "longest", "peak memory", "files", "size")
    return _table(names, rows)


def _versions(versions: Sequence[MadeWith]) -> str:
    rows = (
        f"<th>{escape(each.stage)}</th><td>{each.files:,}</td>"
        f"<td>{escape(', '.join(f'{name} {version}' for name, version in each.tools.items()))}</td>"
        f"<td>{escape(each.maker)}</td><td>{escape(each.host)}</td>"
        for each in versions
    )
    return _table(("stage", "files", "versions", "program", "machine"), rows, kind="texts")
