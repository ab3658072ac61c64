"""Benchmarks that draw print JSON, and nothing of what Blender writes to the same descriptor."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from places import PROJECT

from benchmarks import cloth
from benchmarks.compare import json_in

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


STAND_IN = """#!/bin/sh
echo "00:00.310  blender          | Read prefs: /home/me/.config/blender/userpref.blend"
echo "[12] what is not the answer"
echo '{"blender": "5.0.1", "times": [[0.2, 0.1], [0.2, 0.1]],'
echo ' "positions": [[0, 0, 0.3], [1, 0, 0.3], [0, 1, 0.3]], "triangles": [[0, 1, 2]]}'
echo "Blender quit"
"""


def test_lines_that_blender_prints_around_its_answer_are_not_part_of_it(tmp_path: Path, monkeypatch):
    stand_in = tmp_path / "python"
    stand_in.write_text(STAND_IN)
    stand_in.chmod(stand_in.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    answer = cloth.measure_blender(2, 1)
    assert answer["blender"] == "5.0.1"
    assert answer["frame_ms"]["median"] == 200.0


def test_output_without_json_is_an_error():
    with pytest.raises(ValueError, match="no JSON in: 'nothing"):
        json_in("nothing\n[like it\n")
