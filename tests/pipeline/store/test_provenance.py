"""Receipts answer where files come from; flipped bits are found wherever they are, and just they are healed."""

import json
import os
import random
import time
from pathlib import Path

import pytest
import synthetic_stages
from command_line import pipeline
from synthetic_jobs import contents, job_text, run_recorded

from pipeline import __version__
from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import digest_of
from pipeline.base.task import ArtifactPath
from pipeline.store.provenance import read_text
from pipeline.store.receipts import Receipt, read_receipt


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    """A finished job of the synthetic stages."""
    monkeypatch.setattr("pipeline.stages.STAGES", synthetic_stages.STAGES)
    layout = JobLayout(tmp_path / "synthetic")
    run(layout)
    return layout


def run(layout: JobLayout, text: str | None = None) -> list[str]:
    """Run the job; returns the tasks that ran."""
    outcome, recorder = run_recorded(layout.root, text)
    assert outcome.exit_code == 0
    return sorted(recorder.ran())


def test_a_receipt_leads_to_the_job_file_the_parameters_and_the_versions(layout: JobLayout) -> None:
    receipt = read_receipt(layout, ArtifactPath("double/000003.bin"))
    assert receipt is not None
    assert layout.job_text(receipt.job).read_text() == job_text()
    parameters = json.loads(layout.parameters_text(receipt.parameters).read_text())
    assert (parameters["stage_name"], parameters["stage_version"]) == ("double", 1)
    assert parameters["camera"]["focal_length_mm"] == 50.0
    assert receipt.inputs.keys() == {"steps/000003.bin"}
    assert receipt.maker.startswith(f"pipeline {__version__}, Python 3.")
    assert receipt.host


def test_files_of_two_versions_of_the_job_each_tell_of_their_own(layout: JobLayout) -> None:
    run(layout, job_text(focal_length_mm=70.0))
    told = pipeline("explain", layout.root, "double/000003.bin", "--json")
    [origin] = json.loads(told.stdout)["provenance"]
    assert (layout.root / origin["job_file"]).read_text() == job_text(focal_length_mm=70.0)
    # The simulation does not read the camera: its files are still those of the first version.
    told = pipeline("explain", layout.root, "steps", "--json")
    [origin] = json.loads(told.stdout)["provenance"]
    assert (layout.root / origin["job_file"]).read_text() == job_text()
    assert (origin["artifacts"], origin["versions"]) == (6, {"stage steps": "1"})


def test_explain_says_it_to_people_and_takes_a_file_for_its_task(layout: JobLayout) -> None:
    told = pipeline("explain", layout.root, "double/000003.bin").stdout
    assert told.startswith("double/000003: done")
    assert "origin  1 file by attempt 1 on " in told
    assert "versions: stage double 1" in told
    assert f"job file: .provenance/jobs/{digest_of(job_text())}.toml" in told


def test_the_story_outlives_the_manifest(layout: JobLayout) -> None:
    layout.manifest.unlink()
    assert run(layout) == []
    [origin] = json.loads(pipeline("explain", layout.root, "film", "--json").stdout)["provenance"]
    assert origin["job_file"] is not None
    assert origin["versions"] == {"stage film": "1"}


def flip_a_bit(path: Path, generator: random.Random) -> None:
    """As a failing disk does: one bit, and the time of modification stays."""
    status = path.stat()
    content = bytearray(path.read_bytes())
    content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def maker(artifact: str) -> str:
    """The task that makes a file of the synthetic job."""
    return "film" if artifact == "film.bin" else artifact.removesuffix(".bin") if "double" in artifact else "steps"


@pytest.mark.parametrize("first", range(3))
def test_any_flipped_bit_is_found_and_just_its_file_is_made_again(layout: JobLayout, first: int) -> None:
    """Over the three runs every file is hit once, and every receipt."""
    generator = random.Random(first)
    whole = contents(layout.root)
    order = sorted(whole)
    hit, receipts = order[first::3], order[(first + 1) % 3 :: 3]
    for artifact in hit:
        flip_a_bit(layout.root / artifact, generator)
    for artifact in receipts:
        flip_a_bit(layout.receipt(ArtifactPath(artifact)), generator)
    artifacts = hit + receipts
    time.sleep(0.01)  # the file system's clock is coarse, and a mark is another time of modification
    verified = pipeline("verify", layout.root, "--deep", "--json")
    assert verified.exit_code == 1
    found = json.loads(verified.stdout)["flaws"]
    assert found.keys() == set(artifacts)
    again = run(layout)
    assert set(again) == {maker(artifact) for artifact in artifacts}
    assert contents(layout.root) == whole
    assert pipeline("verify", layout.root, "--deep").exit_code == 0


def test_no_bit_of_a_receipt_can_flip_unseen(layout: JobLayout) -> None:
    content = layout.receipt(ArtifactPath("double/000003.bin")).read_bytes()
    unseen = []
    for place in range(len(content)):
        for bit in range(8):
            flipped = bytearray(content)
            flipped[place] ^= 1 << bit
            try:
                Receipt.from_json(flipped.decode())
            except (InvalidArtifactError, UnicodeDecodeError):
                continue
            unseen.append((place, bit))
    assert unseen == []


def test_a_missing_receipt_is_found_and_its_file_made_again(layout: JobLayout) -> None:
    layout.receipt(ArtifactPath("double/000002.bin")).unlink()
    verified = pipeline("verify", layout.root, "--deep")
    assert "double/000002.bin: its receipt is missing or damaged" in verified.stdout
    assert run(layout) == ["double/000002"]
    assert pipeline("verify", layout.root, "--deep").exit_code == 0


@pytest.mark.parametrize("kind", ["jobs", "parameters"])
def test_a_damaged_text_of_the_provenance_is_written_anew(layout: JobLayout, kind: str) -> None:
    text = sorted((layout.provenance / kind).iterdir())[0]
    flip_a_bit(text, random.Random(1))
    assert read_text(text) is None
    verified = pipeline("verify", layout.root, "--deep")
    assert verified.exit_code == 1
    assert f"{kind}/{text.name}: is not what its name says; written anew" in verified.stdout
    assert read_text(text) is not None
    assert pipeline("verify", layout.root, "--deep").exit_code == 0


def test_a_damaged_text_that_nothing_else_knows_is_removed(layout: JobLayout) -> None:
    text = layout.job_text(digest_of(job_text()))
    run(layout, job_text(focal_length_mm=70.0))  # the folder's job file is another one now
    flip_a_bit(text, random.Random(1))
    verified = pipeline("verify", layout.root, "--deep")
    assert f"jobs/{text.name}: is not what its name says; removed; nothing else knows it" in verified.stdout
    assert (verified.exit_code, text.exists()) == (1, False)
    assert pipeline("verify", layout.root, "--deep").exit_code == 0


def test_clean_removes_by_stage_and_age(layout: JobLayout) -> None:
    old = time.time() - 3 * 86400
    for frame in range(3):
        os.utime(layout.root / f"double/{frame:06d}.bin", (old, old))
    would = pipeline("clean", layout.root, "--stage", "double", "--older-than", "2d")
    assert would.stdout.startswith("would remove 3 files")
    assert len(contents(layout.root)) == 13
    assert pipeline("clean", layout.root, "--stage", "double", "--older-than", "2d", "--yes").exit_code == 0
    assert len(contents(layout.root)) == 10
    assert run(layout) == ["double/000000", "double/000001", "double/000002"]
    assert "is not an age" in pipeline("clean", layout.root, "--stage", "double", "--older-than", "soon").stderr


def test_clean_removes_what_a_shorter_film_has_no_use_for_and_old_logs(layout: JobLayout) -> None:
    run(layout, job_text(frames=4))
    assert len(contents(layout.root)) == 13
    assert pipeline("clean", layout.root, "--superseded", "--yes").exit_code == 0
    assert len(contents(layout.root)) == 9
    assert sorted(path.name for path in (layout.root / "logs").glob("film.*")) in ([], ["film.2.log"])
    assert run(layout, job_text(frames=4)) == []
    assert pipeline("verify", layout.root, "--deep").exit_code == 0
