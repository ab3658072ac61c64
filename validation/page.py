"""Keeps docs/validation: the numbers as JSON, the figures, and the tables of its page."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from validation.cases import CASES, load_case
from validation.checks import TITLES, CaseResult, Check

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "validation"
PAGE = "README.md"

DEVICES = {"cpu": "a CPU", "cuda": "a GPU"}

_TABLE = re.compile(r"(?P<head><!-- numbers: (?P<case>[a-z-]+) -->\n).*?(?P<tail><!-- end -->)", re.DOTALL)


def load_results(name: str, folder: Path = FOLDER) -> list[CaseResult]:
    """The kept results of a case, in the order of its solvers; none where it was never computed."""
    path = folder / f"{name}.json"
    if not path.exists():
        return []
    return [CaseResult.from_json(each) for each in json.loads(path.read_text(encoding="utf-8"))["results"]]


def keep_result(result: CaseResult, folder: Path = FOLDER) -> None:
    """Put one solver's result in the place of its last one, and draw the case anew."""
    others = {each.solver: each for each in load_results(result.case, folder)}
    results = {**others, result.solver: result}
    kept = [results[solver] for solver in TITLES if solver in results]
    data = {
        "case": result.case,
        "command": f"python -m validation --full {result.case}",
        "results": [each.as_json() for each in kept],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{result.case}.json").write_text(_compact(data), encoding="utf-8")
    keep_figure(result.case, folder)


def keep_figure(name: str, folder: Path = FOLDER) -> None:
    """Draw a case from its kept results."""
    draw = load_case(name).draw
    if draw is not None:
        draw(load_results(name, folder)).savefig(folder / f"{name}.svg", metadata={"Date": None}, bbox_inches="tight")


def update_page(folder: Path) -> None:
    """Make the tables of the page that lies there anew."""
    page = folder / PAGE
    if page.exists():
        page.write_text(with_tables(page.read_text(encoding="utf-8"), folder), encoding="utf-8")


def with_tables(text: str, folder: Path = FOLDER) -> str:
    """The page with its tables made from the kept results. Raises KeyError where it names a case that there is not."""

    def table(match: re.Match[str]) -> str:
        name = match["case"]
        if name not in CASES:
            raise KeyError(f'the page has a table of "{name}", which is no case')
        return f"{match['head']}{table_of(load_results(name, folder))}{match['tail']}"

    return _TABLE.sub(table, text)


def table_of(results: Sequence[CaseResult]) -> str:
    """The numbers of a case as a Markdown table, one column a solver; what fails is bold; and what computed them."""
    if not results:
        return "not computed\n"
    names = list(dict.fromkeys(check.name for each in results for check in each.checks))
    by_solver = [{check.name: check for check in each.checks} for each in results]
    titles = " | ".join(TITLES[each.solver] for each in results)
    lines = [
        f"| number | should be | within | {titles} | why this tolerance |",
        "|---|---|---|" + "---|" * (len(results) + 1),
    ]
    for name in names:
        first = next(checks[name] for checks in by_solver if name in checks)
        cells = [_cell(checks.get(name)) for checks in by_solver]
        unit = "" if first.unit == "-" else f" [{first.unit}]"
        row = [f"{name}{unit}", f"{first.expected:.5g}", f"{first.tolerance:.2g}", *cells, first.reason]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |")
    devices = [DEVICES.get(each, each) for each in dict.fromkeys(each.device for each in results)]
    lines += ["", f"Computed on {' and '.join(devices)}."]
    return "\n".join(lines) + "\n"


def _cell(check: Check | None) -> str:
    if check is None:
        return "–"
    return f"{check.value:.5g}" if check.holds else f"**{check.value:.5g}**"


def _compact(data: object) -> str:
    """JSON with lists of numbers on one line each."""
    text = json.dumps(data, indent=1, ensure_ascii=False)
    return re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", lambda match: "[" + re.sub(r"\s+", " ", match[1]) + "]", text) + "\n"
