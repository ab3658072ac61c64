"""Benchmarks that draw print JSON, and nothing of what Blender writes to the same descriptor."""

from __future__ import annotations

import json
import subprocess
import sys

from places import PROJECT

DRAWS = """
import json, os, sys
from benchmarks.compare import keep_output_for_json
keep_output_for_json()
os.write(1, b"00:02.892  cycles | WARNING\\n")
json.dump({"benchmark": "presets"}, sys.stdout)
os.write(1, b"Blender quit\\n")
"""


def test_what_libraries_write_is_not_among_the_json():
    project = PROJECT
    child = subprocess.run([sys.executable, "-c", DRAWS], cwd=project, capture_output=True, text=True, check=True)
    assert json.loads(child.stdout) == {"benchmark": "presets"}
    assert child.stderr == "00:02.892  cycles | WARNING\nBlender quit\n"
