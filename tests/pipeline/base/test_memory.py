"""Limits of memory, and kills for want of it, of a real control group; skipped where none can be made."""

import os
import subprocess
import sys

from memory_group import memory_group

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


def test_a_control_groups_limit_is_the_machines_and_its_kills_are_counted():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with memory_group(LIMIT_BYTES) as group:
        command = [sys.executable, "-c", CODE, str(group)]
        told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout.split()
    assert abs(int(told[0]) - LIMIT_BYTES) < 10_000  # whole pages
    assert told[1:] == ["-9", "1"]
