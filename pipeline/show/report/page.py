"""The report's page: HTML with its style, charts, pictures and numbers inside. Pure."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from html import escape

from pipeline.show.report.chart import COLORS, line_chart, swatch
from pipeline.show.report.job_report import JobReport
from pipeline.show.report.job_section import job_section, origins_section
from pipeline.show.report.panels import Panel, panels_of


def page(reports: Sequence[JobReport], *, written: str) -> str:
    """The page of one job, or of several in the same charts.

    Args:
        reports: the jobs; titles differ.
        written: when, in words.
    """
    title = " and ".join(report.title for report in reports)
    found = panels_of([report.numbers for report in reports])
    sections = [_section(f"Solvers{_over(reports)}", _charts(found.panels, found.zero))]
    if len(reports) > 1:
        sections.insert(0, _section("Energy kept", _energies(reports)))
    body = [
        f"<header><h1>{escape(title)}</h1><p>{escape(written)}</p></header>",
        *(job_section(report, headed=len(reports) > 1) for report in reports),
        *sections,
        _section("What it was made of", "".join(origins_section(each, headed=len(reports) > 1) for each in reports)),
    ]
    data = _json({"written": written, "jobs": [report.as_json() for report in reports]})
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + f'\n<script type="application/json" id="numbers">{data}</script>\n</body>\n</html>\n'
    )


def _over(reports: Sequence[JobReport]) -> str:
    return "" if len(reports) == 1 else " in comparison"


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


_STYLE = """
:root { color-scheme: light dark; --paper: #fcfcfb; --soft-paper: #f2f1ed;
  --ink: #1d1d1b; --soft: #62615c; --rule: #dddcd6; --bar: #cfe0f5;
  --warn: #8a4b00; --c0: #2a78d6; --c1: #d9541e; --c2: #12875f; --c3: #a86f00; --c4: #b93c7f; --c5: #4a3aa7;
  --c6: #6b6b66; --c7: #c22f2f;
  --s0: #2567b5; --s1: #b8481a; --s2: #107350; --s3: #8a5c00; --s4: #9c3369;
  --s5: #4a3aa7; --s6: #5c5c58; --s7: #a82828; }
@media (prefers-color-scheme: dark) { :root { --paper: #171716;
  --soft-paper: #222120; --ink: #ecebe6; --soft: #a3a29b; --rule: #3a3936;
  --bar: #24456b; --warn: #f0b45c; --c0: #5a9fee; --c1: #f07c4a; --c2: #35b98a; --c3: #d9a02c; --c4: #e578b0;
  --c5: #a196f0; --c6: #a9a8a1; --c7: #f07373; } }
body { margin: 0 auto; max-width: 86rem; padding: 1.5rem; background: var(--paper); color: var(--ink);
  font: 15px/1.45 system-ui, sans-serif; }
h1 { font-size: 1.9rem; letter-spacing: -.015em; margin: 0; } h2 { font-size: 1.25rem; margin: 2.4rem 0 .8rem; }
h3 { font-size: 1.05rem; margin: 1.8rem 0 .6rem; } header { margin-bottom: 1.2rem; }
.head { display: grid; grid-template-columns: minmax(0, 3fr) minmax(16rem, 2fr); gap: 1.6rem; align-items: start; }
@media (max-width: 50rem) { .head { grid-template-columns: 1fr; } }
.film { display: block; width: 100%; height: auto; border-radius: 6px; background: #111; }
.shares { display: flex; height: 2rem; border-radius: 6px; overflow: hidden; gap: 1px; }
.shares span { flex: 0 1 0; min-width: 2px; overflow: hidden; white-space: nowrap; color: #fff; font-size: 13px;
  line-height: 2rem; padding-left: .5rem; box-sizing: border-box; text-overflow: ellipsis; }
.shares span:empty { padding: 0; }
details { border-top: 1px solid var(--rule); padding: .6rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font: 13px/1.45 ui-monospace, monospace; background: var(--soft-paper); padding: 1rem;
  border-radius: 6px; }
.texts td, .texts th { text-align: left; vertical-align: top; } .texts td { white-space: normal; }
header p, .quiet { color: var(--soft); margin: .3rem 0; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; margin: 0 0 .8rem; }
dt { color: var(--soft); } dd { margin: 0; }
.warnings { color: var(--warn); padding-left: 1.2rem; }
.sheet { max-width: 100%; display: block; margin: .8rem 0; border-radius: 4px; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .8rem; text-align: right; border-bottom: 1px solid var(--rule); white-space: nowrap; }
th:first-child { text-align: left; } thead th { color: var(--soft); font-weight: 500; }
.bar { position: relative; min-width: 9rem; } .bar span { position: absolute; inset: 3px auto 3px 0;
  background: var(--bar); border-radius: 2px; z-index: -1; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 28rem), 1fr)); gap: 1.6rem; }
figure { margin: 0; } figcaption { font-weight: 600; }
figure ul { list-style: none; margin: .2rem 0; padding: 0; display: flex; flex-wrap: wrap; gap: .1rem 1rem;
  font-size: 13px; color: var(--soft); }
figure > svg { width: 100%; height: auto; display: block; } .swatch { width: 28px; height: 8px; margin-right: .4rem; }
.line { fill: none; stroke-width: 1.8; stroke-linejoin: round; stroke-linecap: round; }
.grid { stroke: var(--rule); } .axis { stroke: var(--soft); } .tick { fill: var(--soft); font-size: 11.5px; }
""" + " ".join(
    f".c{index} {{ stroke: var(--c{index}); }} .b{index} {{ background: var(--s{index}); }}" for index in range(COLORS)
)
