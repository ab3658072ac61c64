"""What the report tells of one job, as HTML: its film, facts, time, frames, versions and its text. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from pipeline.base import wording
from pipeline.record.reader import StageTiming
from pipeline.run.plan import frame_ranges
from pipeline.run.solver_numbers import unreadable_whitewater
from pipeline.show.report.film import ReportFilm
from pipeline.show.report.job_report import JobReport, MadeWith, as_data

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
        parts.append(f'<img class="sheet" src="{as_data(report.sheet)}" alt="frames of {escape(report.title)}">')
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
    if film.mime.startswith("video/"):
        shown = f'<video class="film" controls loop muted playsinline {size} src="{film.address}"></video>'
    else:
        shown = f'<img class="film" {size} src="{film.address}" alt="film of {escape(title)}">'
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
    rows = "".join(
        f"<tr><th>{escape(timing.stage)}</th><td>{timing.attempts:,}</td><td>{timing.failed:,}</td>"
        f'<td class="bar"><span style="width:{100.0 * timing.seconds / most:.1f}%"></span>'
        f"{wording.duration(timing.seconds)}</td><td>{wording.duration(timing.longest_s)}</td>"
        f"<td>{wording.size(timing.peak_memory_bytes) if timing.peak_memory_bytes else '–'}</td>"
        f"<td>{timing.artifacts:,}</td><td>{wording.size(timing.bytes)}</td></tr>"
        for timing in timings
    )
    head = "".join(
        f"<th>{name}</th>"
        for name in ("stage", "attempts", "failed", "time of all", "longest", "peak memory", "files", "size")
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _versions(versions: Sequence[MadeWith]) -> str:
    rows = "".join(
        f"<tr><th>{escape(each.stage)}</th><td>{each.files:,}</td>"
        f"<td>{escape(', '.join(f'{name} {version}' for name, version in each.tools.items()))}</td>"
        f"<td>{escape(each.maker)}</td><td>{escape(each.host)}</td></tr>"
        for each in versions
    )
    head = "".join(f"<th>{name}</th>" for name in ("stage", "files", "versions", "program", "machine"))
    return f'<div class="wide"><table class="texts"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
