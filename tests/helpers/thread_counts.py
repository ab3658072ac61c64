"""The same code on different numbers of threads, each in a process of its own, as Taichi starts once a process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from places import PROJECT


def outputs_by_threads(code: str, *arguments: str, beside: str, counts: tuple[int, ...] = (1, 2)) -> list[str]:
    """What the code prints for each number of threads, which is its `sys.argv[1]`.

    Args:
        code: a program; it may import the project, and the modules that lie beside the test.
        arguments: further ones of the program.
        beside: `__file__` of the test.
        counts: numbers of threads.
    """
    here = Path(__file__).resolve().parent
    paths = [str(PROJECT), str(here), str(Path(beside).resolve().parent), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    outputs = []
    for threads in counts:
        child = subprocess.run(
            [sys.executable, "-c", code, str(threads), *arguments],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert child.returncode == 0, f"the program on {threads} threads ended with {child.returncode}:\n{child.stderr}"
        outputs.append(child.stdout)
    return outputs
