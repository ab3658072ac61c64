"""What makes all tests quick: bytecode that outlives processes, and families of tests that stay together."""

import os
import sys
from pathlib import Path
from typing import Any

import pytest

FAMILIES = {"cloth": "cloth", "coupling": "fluid", "fluid": "fluid", "rigid": "rigid", "smoke": "smoke"}
"""Folders of tests/sim whose tests share kernels, and a name for those that share them."""

ON_THEIR_OWN = {"tests/acceptance/test_sample_jobs.py"}
"""Files of long tests that share nothing; they fill up whichever process is done first."""


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


def family_of(nodeid: str) -> str:
    """What `pytest -n 2 --dist loadfile` gives to one process: files, but families that compile the same kernels."""
    path = nodeid.partition("::")[0]
    if path in ON_THEIR_OWN:
        return nodeid
    folders = path.split("/")[:-1]
    is_kin = len(folders) == 3 and folders[:2] == ["tests", "sim"] and folders[2] in FAMILIES
    return FAMILIES[folders[2]] if is_kin else path


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep families in one process, too, where files are asked to be."""
    from xdist.scheduler import LoadScopeScheduling

    class FamilyScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return family_of(nodeid)

    return FamilyScheduling(config, log) if config.getvalue("dist") == "loadfile" else None
