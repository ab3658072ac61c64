"""Two checkouts are compared by what their own benchmarks print, in turns, and by what both tell."""

import json
from pathlib import Path

import pytest

from benchmarks import compare


@pytest.fixture
def trees(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """This checkout and another one, whose benchmark is twice as fast and tells less; each notes its turns."""
    for name, milliseconds, more in (("here", 6.0, {"new_ms": 1.0}), ("there", 3.0, {})):
        step = {"particles": 8, "dt_s": 0.1, "step_ms": {"median": milliseconds, "least": 1.0}}
        told = json.dumps({"runs": [step], "plan": [2.0, milliseconds], **more})
        (tmp_path / name / "benchmarks").mkdir(parents=True)
        (tmp_path / name / "benchmarks" / "swim.py").write_text(
            f"print({told!r})\nopen({str(tmp_path / 'turns')!r}, 'a').write('{name} ')\n"
        )
    monkeypatch.setattr(compare, "HERE", tmp_path / "here")
    return tmp_path / "here", tmp_path / "there"


def test_what_both_tell_is_compared_turn_by_turn_after_one_that_warms_up(trees, tmp_path):
    turns = compare.take_turns(lambda tree: compare.benchmark(tree, "swim"), trees[1], 2)
    told = {"runs/0/step_ms": (6.0, 3.0, 2.0), "plan": (2.0, 2.0, 1.0), "plan, processor": (6.0, 3.0, 2.0)}
    assert compare.ratios(turns) == told
    assert (tmp_path / "turns").read_text().split() == ["there", "here", "here", "there", "there", "here"]


def test_table_says_what_is_slower_or_faster_beyond_noise():
    numbers = [({"a_s": 1.02, "b_s": 1.04, "c_s": 0.5}, {"a_s": 1.0, "b_s": 1.0, "c_s": 1.0})]
    rows = compare.table({"swim": numbers}).splitlines()[2:]
    assert [row.split("|")[5].strip() for row in rows] == ["", "slower", "faster"]
