"""A short campaign, as CI runs it; a long one is made by hand, and its tables are in docs/guide/reliability.md."""

import json
import random
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest

from . import faults
from .campaign import MIXED, draw_kinds
from .faults import KINDS
from .promises import broken_promises
from .studio import PROJECT, SCENES, Studio
from .table import Result, Row

FAULTS = 8
SEED = 135030
"""Its faults, of the first mixed round, are such that each of the main promises is put to the test."""
PATIENCE_S = 1800.0
"""Each run has limits of its own; a busy machine may take its time for all of them."""


TWO_OF_A_NUMBER = """
import subprocess, sys
from tests.campaign.family import Family

family = Family()
child = subprocess.Popen([sys.executable, "-c", "input(); raise SystemExit(3)"], stdin=subprocess.PIPE)
family._codes[child.pid] = 7  # of a process that had this number before
family.adopt(child)
print(family.exit_code(child.pid), flush=True)
child.stdin.write(b"\\n")
child.stdin.close()
print(family.wait(child.pid, 30.0))
"""


def campaign(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.campaign", *arguments]
    return subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def test_the_faults_of_a_mixed_round_are_of_different_kinds() -> None:
    drawn = [kind.name for kind in draw_kinds(random.Random(SEED), KINDS, FAULTS)]
    assert {"kill -9 of the runner", "kill -9 of a worker", "kill -9 of Blender", "disk full"} <= {*drawn}
    assert "kill -9 of all processes at once" in drawn
    assert {"output truncated", "bit of an output flipped, unseen", "clock jumps"} <= {*drawn}
    assert {*draw_kinds(random.Random(SEED), KINDS, 2 * len(KINDS))} == {*KINDS}
    assert len({*draw_kinds(random.Random(SEED), KINDS, len(KINDS))}) == len(KINDS)


def test_a_disk_that_cannot_shrink_that_far_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: str) -> None:
        raise subprocess.CalledProcessError(32, ["mount", *arguments])

    monkeypatch.setattr(faults, "_mount", refuse)
    studio = Studio.open(tmp_path, scene="ball")
    studio.root.mkdir(parents=True)
    situation = faults.Situation(studio, cast("Any", None), random.Random(1), may_mount=True)
    assert not KINDS[0].inject(situation)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S + 60.0)
def test_a_job_under_eight_faults_keeps_every_promise(tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    ended = campaign(
        "--seed", str(SEED), "--kills", str(FAULTS), "--per-round", str(FAULTS), "--quick", "--json", str(result)
    )
    assert ended.returncode == 0, f"{ended.stderr}\n{ended.stdout}"
    told = json.loads(result.read_text())
    row = told["rows"][MIXED]
    assert (row["injected"], row["survived"], told["broken"]) == (FAULTS, FAULTS, [])
    assert row["runs"] > 1
    assert f"| **all** | {FAULTS} | {FAULTS} |" in ended.stdout


def test_a_process_with_the_number_of_an_earlier_one_is_told_apart() -> None:
    """Numbers of processes come again within an hour of faults; the family is that of a process of its own."""
    ended = subprocess.run(
        [sys.executable, "-c", TWO_OF_A_NUMBER], cwd=PROJECT, capture_output=True, text=True, check=False, timeout=60.0
    )
    assert ended.stdout.split() == ["None", "3"], ended.stderr


def test_help_has_examples_and_unknown_faults_are_refused() -> None:
    assert "python -m tests.campaign --seed 1 --kills 200" in campaign("--help").stdout
    assert campaign("--list").stdout.splitlines() == [kind.name for kind in KINDS]
    refused = campaign("--only", "meteor")
    assert (refused.returncode, "no fault is called meteor" in refused.stderr) == (2, True)


def test_the_table_sums_up_and_is_told_in_json_too() -> None:
    result = Result(seed=3, scene="ball", undisturbed_s=10.0, outputs=20)
    result.rows["disk full"] = Row(injected=4, survived=4, runs=5, processor_s=20.0, made_again=8)
    result.rows["meteor"] = Row(injected=4, survived=0, runs=1, processor_s=0.0, broken=["movie.mp4 is missing"])
    result.moments["at a commit"] += 1
    assert "| disk full | 4 | 4 | 10.0 | 50 |" in result.markdown()
    assert "| **all** | 8 | 4 | 5.0 | 25 |" in result.markdown()
    told = json.loads(json.dumps(result.to_json()))
    assert told["broken"] == ["meteor: movie.mp4 is missing"]
    assert (told["rows"]["disk full"]["runs"], told["moments"]) == (5, {"at a commit": 1})


def test_broken_promises_are_found(tmp_path: Path) -> None:
    """The campaign's own eyes: a job's folder with everything wrong in it."""
    studio = Studio.open(tmp_path, scene=random.Random(1).choice(sorted(SCENES)))
    (studio.root / "frames").mkdir(parents=True)
    (studio.root / "frames" / "000000.png").write_bytes(b"another picture")
    (studio.root / "frames" / ".000001.png.part.3").write_bytes(b"half")
    (studio.root / "runner.lease").write_text("{}")
    (studio.folder / "out.txt").write_text("Traceback (most recent call last):")
    broken = list(broken_promises(studio, {"frames/000000.png": "0", "movie.mp4": "0"}, frozenset()))
    assert broken == [
        "frames/000000.png differs",
        "movie.mp4 is missing",
        "the record is wrong about frames/000000.png, movie.mp4",
        "a lease is left",
        "unfinished files are left: frames/.000001.png.part.3",
        "a command ended in a traceback",
    ]
