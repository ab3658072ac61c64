"""Runs code where bpy may be imported: in a child process, one process for one Blender."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]


def run_inside_blender(code: str, *arguments: str) -> None:
    """Run code with its assertions; arguments are its `sys.argv[1:]`."""
    completed = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *arguments],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr
