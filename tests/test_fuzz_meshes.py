"""Spoiled mesh files become a solid or a sentence: a short run of `python tests/helpers/fuzz_meshes.py`."""

from pathlib import Path

from fuzz_meshes import fuzz


def test_spoiled_meshes_are_taken_or_refused_soon(tmp_path: Path) -> None:
    report = fuzz(seed=21, count=120, folder=tmp_path)
    assert report.broken == []
    assert (report.accepted > 5, report.refused > 50, report.accepted + report.refused) == (True, True, 120)
