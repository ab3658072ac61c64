"""The same computation with different numbers of threads, in two processes, as Taichi starts once a process."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import PROJECT

from sim.core.runtime import initialize


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """Digest of all bits of a checkpoint."""
    digest = hashlib.sha256()
    for _, array in sorted(arrays.items()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def result_on_any_threads(function: Callable[..., Any], *arguments: Any, threads: int = 1) -> Any:
    """What a function returns in this process, which must be what it returns in a child with so many threads.

    Args:
        function: one of a test module's own; it computes with Taichi, and JSON can carry what it returns.
        arguments: its arguments, which JSON can carry.
        threads: those of the child; one more if this process, which has one per core, has as many.
    """
    if initialize() != "cpu":
        pytest.skip("numbers of threads are compared on the CPU")
    cores = len(os.sched_getaffinity(0))
    result = function(*arguments)
    there = result_on_threads(threads + (threads == cores), function, *arguments)
    assert json.loads(json.dumps(result)) == there
    return result


def result_on_threads(threads: int, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function of a test module returns in a child process with so many threads; the arguments are as above."""
    code = (
        "import json, sys\n"
        "from sim.core.runtime import initialize\n"
        f"initialize('cpu', threads={threads})\n"
        f"from {function.__module__} import {function.__name__} as function\n"
        "print(json.dumps(function(*json.loads(sys.argv[1]))))"
    )
    folders = [PROJECT, Path(__file__).parent, Path(function.__code__.co_filename).parent]
    paths = [*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]
    child = subprocess.run(
        [sys.executable, "-c", code, json.dumps(arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert child.returncode == 0, f"the child on {threads} threads ended with {child.returncode}:\n{child.stderr}"
    return json.loads(child.stdout.splitlines()[-1])
