"""`verify` and `clean` on folders of the synthetic job; and what reads a damaged record."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from command_line import pipeline
from synthetic_jobs import contents, run_synthetic

from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease, live_holder
from pipeline.base.task import ArtifactPath
from pipeline.run.executors.inline import InlineExecutor


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    """The folder of a finished job; its path has a space, for what is printed must run as it stands."""
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "my films" / "synthetic", executor)
    return JobLayout(tmp_path / "my films" / "synthetic")


@pytest.mark.parametrize("command", ["status", "explain", "plan", "submit"])
def test_a_record_with_damaged_pages_is_told_with_a_remedy_that_works(layout: JobLayout, command: str) -> None:
    content = bytearray(layout.manifest.read_bytes())
    content[4096:] = b"\xa5" * (len(content) - 4096)
    layout.manifest.write_bytes(content)
    of_file = [layout.job_file, "--output", layout.root.parent]
    of_folder = {"status": [layout.root], "explain": [layout.root, "simulate"]}
    refused = pipeline(command, *of_folder.get(command, of_file))
    assert (refused.exit_code, refused.stdout) == (1, "")
    assert "manifest.db is damaged" in refused.stderr
    remedy = shlex.split(refused.stderr.strip().rpartition("with: pipeline ")[2])
    assert pipeline(*remedy).exit_code == 0
    assert pipeline("status", layout.root).exit_code == 0


def test_clean_of_everything_leaves_no_folder(layout: JobLayout) -> None:
    assert pipeline("clean", layout.root, "--all").exit_code == 0
    assert len(contents(layout.root)) == 13
    assert pipeline("clean", layout.root, "--all", "--yes").exit_code == 0
    assert not layout.root.exists()


def test_a_job_submitted_while_its_folder_is_cleaned_keeps_the_folder(
    layout: JobLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = Lease.release

    def release_to_another(self: Lease) -> None:
        release(self)
        Lease.acquire(layout.lease)

    monkeypatch.setattr(Lease, "release", release_to_another)
    assert pipeline("clean", layout.root, "--all", "--yes").exit_code == 0
    assert live_holder(layout.lease) is not None


def test_clean_of_a_stage_removes_its_files_and_receipts(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    import synthetic_stages

    monkeypatch.setattr("pipeline.stages.STAGES", synthetic_stages.STAGES)
    assert pipeline("clean", layout.root, "--stage", "double", "--yes").exit_code == 0
    assert sorted(contents(layout.root)) == ["film.bin", *(f"steps/{k:06d}.bin" for k in range(6))]
    assert not layout.receipt(ArtifactPath("double/000000.bin")).exists()
    verified = pipeline("verify", layout.root)
    assert (verified.exit_code, verified.stdout[:15]) == (0, "7 files checked")
