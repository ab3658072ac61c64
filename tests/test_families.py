"""Which tests share a process in CI, and in which order families begin."""

import runpy

import pytest
from places import PROJECT

CONFTEST = runpy.run_path(str(PROJECT / "tests" / "conftest.py"))
FILES = sorted(path.relative_to(PROJECT).as_posix() for path in (PROJECT / "tests").rglob("test_*.py"))

family_of, in_order_of_families = CONFTEST["family_of"], CONFTEST["in_order_of_families"]


@pytest.mark.parametrize("family", CONFTEST["ORDER"])
def test_every_family_that_comes_first_has_tests(family):
    assert family in {family_of(f"{path}::test") for path in FILES}


@pytest.mark.parametrize("path", sorted(CONFTEST["FILMS"] | CONFTEST["ON_THEIR_OWN"] | {CONFTEST["VALIDATION_CASES"]}))
def test_every_file_that_is_named_is_there(path):
    assert path in FILES


def test_families_stay_together_and_begin_with_those_that_are_named_and_then_with_the_largest():
    nodeids = [
        "tests/acceptance/test_sample_jobs.py::test_b",
        "tests/acceptance/test_faults.py::test_a",
        "tests/test_small.py::test_a",
        "tests/pipeline/test_large.py::test_a",
        "tests/pipeline/test_large.py::test_b",
        "tests/sim/fluid/test_dfsph.py::test_a",
        "tests/sim/smoke/test_smoke_solver.py::test_b",
        "tests/acceptance/test_end_to_end.py::test_b",
        "tests/sim/smoke/test_smoke_solver.py::test_a",
        "tests/validation/test_validation_cases.py::test_a",
    ]
    assert in_order_of_families(nodeids) == [nodeids[place] for place in (6, 8, 5, 9, 1, 7, 3, 4, 0, 2)]
