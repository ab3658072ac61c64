"""`verify` and `clean` on folders of the synthetic job; and what reads a damaged record."""

import os
import shlex
from pathlib import Path

import pytest
from command_line import pipeline
from farm_processes import Farm
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


@pytest.mark.parametrize("command", ["status", "explain", "plan"])
def test_a_record_with_damaged_pages_is_told_with_a_remedy_that_works(layout: JobLayout, command: str) -> None:
    content = bytearray(layout.manifest.read_bytes())
    content[4096:] = b"\xa5" * (len(content) - 4096)
    layout.manifest.write_bytes(content)
    of_file = [layout.job_file, "--farm", layout.root.parent]
    of_folder = {"status": [layout.root], "explain": [layout.root, "simulate"]}
    refused = pipeline(command, *of_folder.get(command, of_file))
    assert (refused.exit_code, refused.stdout) == (1, "")
    assert "manifest.db is damaged" in refused.stderr
    remedy = shlex.split(refused.stderr.strip().rpartition("does: pipeline ")[2])
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


def test_files_that_were_edited_stay_when_their_stage_is_cleaned(
    layout: JobLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    import synthetic_stages

    monkeypatch.setattr("pipeline.stages.STAGES", synthetic_stages.STAGES)
    edited = ArtifactPath("double/000002.bin")
    layout.path(edited).write_text("edited by hand")
    cleaned = pipeline("clean", layout.root, "--stage", "double", "--yes")
    assert "removing 5 files" in cleaned.output
    assert f"{edited} stays: file was edited" in cleaned.output
    assert layout.path(edited).read_text() == "edited by hand"
    assert layout.receipt(edited).exists()


def test_a_damaged_job_file_of_the_folder_is_replaced_by_the_one_that_is_submitted(tmp_path: Path) -> None:
    farm = Farm(tmp_path)
    farm.job("film", frames=2)
    layout = farm.layout("film")
    farm.here("submit", "film.toml")
    whole = layout.job_file.read_bytes()
    layout.job_file.write_bytes(bytes([whole[0] ^ 0x80]) + whole[1:])
    refused = farm.here("resume", "film", code=2)
    assert "not UTF-8 text (byte 0 is" in refused.err
    remedy = shlex.split(refused.err.strip().partition("is kept: ")[2])
    assert farm.here("verify", "film", "--deep").code == 0
    farm.here("submit", "film.toml")
    assert layout.job_file.read_bytes() == (tmp_path / remedy[1]).read_bytes() == whole
    farm.close()


def test_pipes_in_the_place_of_files_hold_up_no_status(layout: JobLayout) -> None:
    for receipt in layout.receipts.rglob("*.json"):
        receipt.unlink()
        os.mkfifo(receipt)
    assert pipeline("status", layout.root).exit_code == 0
    assert pipeline("status", "--farm", layout.root.parent).exit_code == 0
    for path in (layout.manifest, layout.goal, layout.lease):
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        told = pipeline("status", layout.root)
        assert (told.exit_code, f"{path} is no file" in told.stderr) == (1, True)
        listed = pipeline("status", "--farm", layout.root.parent)
        assert f"{path} is no file" in listed.output


@pytest.mark.parametrize("content", [b"garbled", b"SQLite format 3\0" + bytes(4080)])
def test_a_garbled_manifest_is_told_with_the_remedy_and_healed_by_the_next_submit(
    tmp_path: Path, content: bytes
) -> None:
    farm = Farm(tmp_path)
    farm.job("film", frames=2)
    layout = farm.layout("film")
    farm.here("submit", "film.toml")
    made = len([*layout.receipts.rglob("*.json")])
    layout.manifest.write_bytes(content)
    told = farm.here("status", "film", code=1).err
    assert "manifest.db is damaged" in told and "Traceback" not in told
    assert told.strip().endswith("pipeline verify renders/film --rebuild")
    healed = farm.here("submit", "film.toml")
    assert f"was damaged and is made anew of {made} receipts" in healed.err
    assert {attempt.message for attempt in farm.attempts("film")} == {"known from its receipt"}
    assert "up to date" in farm.here("submit", "film.toml").out
    farm.close()
