"""Computes validation cases; the full ones go into docs/validation, figures and tables included.

python -m benchmarks.validation                         all cases with all their solvers
python -m benchmarks.validation dam-break --solver dfsph
python -m benchmarks.validation --quick                 as the tests do; prints, keeps nothing
python -m benchmarks.validation --redraw                figures and tables from the kept numbers
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from benchmarks.validation.cases import CASES, compute, load_case
from benchmarks.validation.page import FOLDER, PAGE, TITLES, keep_figure, keep_result, load_results, with_tables
from sim.runtime import initialize


def main() -> int:
    """Run what the command line names; 1 where a number is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", metavar="CASE", help=f"{', '.join(CASES)}; all if omitted")
    parser.add_argument("--solver", action="append", choices=[*TITLES], help="all if omitted")
    parser.add_argument("--quick", action="store_true", help="small; prints the numbers and keeps nothing")
    parser.add_argument("--redraw", action="store_true", help="computes nothing")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=FOLDER, help="folder of figures, numbers and page")
    arguments = parser.parse_args()
    if unknown := set(arguments.case) - set(CASES):
        parser.error(f"unknown case {', '.join(sorted(unknown))}; choose from {', '.join(CASES)}")
    names = arguments.case or list(CASES)
    if arguments.redraw:
        for name in names:
            if load_results(name, arguments.output):
                keep_figure(name, arguments.output)
        _update_page(arguments.output)
        return 0
    device = initialize(arguments.device)
    failures = 0
    for name in names:
        for solver in load_case(name).solvers:
            if arguments.solver and solver not in arguments.solver:
                continue
            result = replace(compute(name, solver, quick=arguments.quick), device=device)
            lines = [f"{name}, {solver}, {result.seconds:.1f} s", *(f"  {check}" for check in result.checks)]
            sys.stdout.write("\n".join(lines) + "\n")
            sys.stdout.flush()
            failures += len(result.failures)
            if not arguments.quick:
                keep_result(result, arguments.output)
    if not arguments.quick:
        _update_page(arguments.output)
    return min(failures, 1)


def _update_page(folder: Path) -> None:
    page = folder / PAGE
    if page.exists():
        page.write_text(with_tables(page.read_text(encoding="utf-8"), folder), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
