"""What makes all tests quick: bytecode that outlives processes, families of tests that stay together."""

import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from processes_seen import busiest

from pipeline.base.threads import BLAS_THREADS

VALIDATION_CASES = "tests/validation/test_validation_cases.py"
"""Of all solvers, and long: a family of its own."""

FILMS = {f"tests/acceptance/test_{name}.py" for name in ("end_to_end", "faults", "interruptions")}
"""Files that look at one and the same film: made once, where one process runs them all."""

ON_THEIR_OWN = {"tests/acceptance/test_sample_jobs.py"}
"""Files of long tests that share nothing; they fill up whichever process is done first."""

ORDER = ("smoke", "fluid", "validation", "cloth", "coupling", "films", "rigid")
"""Families that begin before all others, the longest first, so that none is left for the end of one process alone."""


def bytecode_folder() -> Path:
    """Where compiled modules are kept; a relative XDG_CACHE_HOME counts as none, as its specification has it."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".cache") / "physics-pipeline" / "bytecode"


def keep_bytecode() -> None:
    """Keep compiled modules where Python is told not to write them beside their sources.

    Tests start some hundred processes: compiling the sources of the libraries anew takes each a second.
    """
    cache = bytecode_folder()
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(cache)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(cache)


if sys.dont_write_bytecode:
    keep_bytecode()
os.environ.update(BLAS_THREADS)  # as the command line does, before numpy is loaded


def family_of(nodeid: str) -> str:
    """What `--dist loadfile` gives to one process: a folder of tests/sim, the tests of a film, or a file."""
    path = nodeid.partition("::")[0]
    if path in ON_THEIR_OWN:
        return nodeid
    if path in FILMS:
        return "films"
    if path == VALIDATION_CASES:
        return "validation"
    folders = path.split("/")[:-1]
    return folders[2] if len(folders) == 3 and folders[:2] == ["tests", "sim"] else path


def in_order_of_families(nodeids: list[str]) -> list[str]:
    """Tests of each family together: those of `ORDER` first, then the others, the largest first."""
    sizes = Counter(map(family_of, nodeids))

    def place(nodeid: str) -> tuple[int, int, str]:
        family = family_of(nodeid)
        rank = ORDER.index(family) if family in ORDER else len(ORDER)
        return rank, -sizes[family], family

    return sorted(nodeids, key=place)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the tests of every process alike; the scheduler hands out families in the order of their first tests."""
    if hasattr(config, "workerinput"):
        by_nodeid = {item.nodeid: item for item in items}
        items[:] = [by_nodeid[nodeid] for nodeid in in_order_of_families(list(by_nodeid))]


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Name what fails as it fails: a run that is broken off has no summary."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(FailuresAsTheyCome(reporter))


class FailuresAsTheyCome:
    """Names each failure where tests run in processes of their own, whose lines tell no names.

    And what the machine was busy with: a test that waits too long may wait for what another one has left behind.
    """

    def __init__(self, reporter: Any) -> None:
        self._reporter = reporter

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A phase of a test has ended."""
        if report.failed and hasattr(report, "node"):
            self._reporter.ensure_newline()
            self._reporter.write_line(f"failed after {report.duration:.0f} s: {report.nodeid}")
            load = ", ".join(f"{each:.0f}" for each in os.getloadavg())
            self._reporter.write_line("\n    ".join([f"  load {load}; busiest:", *busiest()]))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep families in one process, too, where files are asked to be, and their order as it was collected."""
    from xdist.scheduler import LoadScopeScheduling

    class FamilyScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return family_of(nodeid)

    if config.getvalue("dist") != "loadfile":
        return None
    config.option.loadscopereorder = False
    return FamilyScheduling(config, log)
