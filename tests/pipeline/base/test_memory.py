"""Limits of memory, and kills for want of it, of a real control group; skipped where none can be made."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.base.memory import _control_groups

LIMIT_BYTES = 200_000_000
CODE = """
import os, subprocess, sys
from pathlib import Path
Path(sys.argv[1], "cgroup.procs").write_text(str(os.getpid()))
from pipeline.base.memory import machine_memory_bytes, out_of_memory_kills
before = out_of_memory_kills()
killed = subprocess.run([sys.executable, "-c", "held = bytearray(b'x') * 600_000_000"]).returncode
print(machine_memory_bytes(), killed, out_of_memory_kills() - before)
"""


@pytest.fixture
def group() -> Iterator[Path]:
    for parent in _control_groups():
        folder = parent / f"test-{os.getpid()}"
        try:
            folder.mkdir()
        except OSError:
            continue
        for name in ("memory.max", "memory.limit_in_bytes"):
            if (folder / name).exists():
                (folder / name).write_text(str(LIMIT_BYTES))
                yield folder
                folder.rmdir()
                return
        folder.rmdir()
    pytest.skip("no control group of memory can be made here")


def test_a_control_groups_limit_is_the_machines_and_its_kills_are_counted(group):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", CODE, str(group)]
    told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout.split()
    assert abs(int(told[0]) - LIMIT_BYTES) < 10_000  # whole pages
    assert told[1:] == ["-9", "1"]
