"""Every validation case at the size that a test can afford, and at night at full size: its numbers are right."""

import pytest

from validation.cases import CASES, load_case

FAST = {("kernel", "wcsph"), ("free-momentum", "wcsph"), ("inertia", "rigid"), ("viscosity", "wcsph")}
"""What takes about a second; all others are marked slow."""

RUNS = [
    pytest.param(case, solver, marks=() if (case, solver) in FAST else pytest.mark.slow, id=f"{case}-{solver}")
    for case in CASES
    for solver in load_case(case).solvers
]


NIGHTLY = pytest.param(False, marks=[pytest.mark.nightly, pytest.mark.timeout(3600)], id="full")


@pytest.mark.parametrize("quick", [pytest.param(True, id="quick"), NIGHTLY])
@pytest.mark.parametrize(("case", "solver"), RUNS)
def test_every_number_of_the_case_is_within_its_tolerance(taichi_cpu, case, solver, quick):
    result = load_case(case).compute(solver, quick=quick)
    assert result.checks
    assert not result.failures, "\n".join(str(check) for check in result.checks)
