"""Computes validation cases, and says of every number whether it is as it should be.

python -m validation                                all cases, small, as the tests do; keeps nothing
python -m validation dam-break --solver dfsph
python -m validation --full                         into docs/validation: numbers, figures and the page's tables
python -m validation --redraw                       figures and tables from the kept numbers
"""

from pathlib import Path

import click

from sim.core.runtime import initialize
from validation.cases import CASES, load_case
from validation.checks import TITLES
from validation.page import FOLDER, keep_figure, keep_result, load_results, update_page


@click.command(help=__doc__.replace("\n\n", "\n\n\b\n"))
@click.argument("names", nargs=-1, metavar="[CASE]...", type=click.Choice(CASES))
@click.option("--solver", "solvers", multiple=True, type=click.Choice([*TITLES]), help="All if omitted.")
@click.option("--full", is_flag=True, help="At full size, hours on two cores; keeps the numbers.")
@click.option("--redraw", is_flag=True, help="Compute nothing.")
@click.option("--device", default="cpu", show_default=True)
@click.option("--output", default=FOLDER, type=click.Path(path_type=Path), help="Folder of figures, numbers and page.")
@click.pass_context
def main(
    context: click.Context,
    *,
    names: tuple[str, ...],
    solvers: tuple[str, ...],
    full: bool,
    redraw: bool,
    device: str,
    output: Path,
) -> None:
    """Compute or redraw what the command line names; exit code 1 where a number is not as it should be."""
    names, failed = names or CASES, False
    if redraw:
        for name in names:
            if load_results(name, output):
                keep_figure(name, output)
    else:
        device = initialize(device)
        for case in map(load_case, names):
            for solver in case.solvers:
                if solvers and solver not in solvers:
                    continue
                result = case.compute(solver, quick=not full, device=device)
                lines = [f"{case.name}, {solver}, {result.seconds:.1f} s", *(f"  {check}" for check in result.checks)]
                click.echo("\n".join(lines))
                failed |= bool(result.failures)
                if full:
                    keep_result(result, output)
    if full or redraw:
        update_page(output)
    context.exit(int(failed))


if __name__ == "__main__":
    main()
