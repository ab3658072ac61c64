"""Runs code in a Python of its own: one process for one Blender, one Taichi, one state of the modules."""

import subprocess
import sys
import textwrap

from places import PROJECT


def run_python(code: str, *arguments: str, timeout_s: float = 300.0) -> str:
    """Run code with its assertions in a fresh Python of this environment, from the project's folder.

    Args:
        code: the program; it may be indented.
        arguments: its `sys.argv[1:]`.
        timeout_s: how long it may take [s].

    Returns:
        What it printed.
    """
    completed = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *arguments],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr
    return completed.stdout
