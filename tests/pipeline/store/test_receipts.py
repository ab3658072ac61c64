"""Receipts: which damage to a file or to its receipt is found, and that it does not count then."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from blake3 import blake3
from record_samples import commit, film

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.task import task_fingerprint
from pipeline.store.receipts import Receipt, hash_file, is_committed, read_receipt, verify_artifact

SIMULATE = film(1)[0]
ARTIFACT = SIMULATE.outputs[0]
FINGERPRINT = task_fingerprint(SIMULATE, {})


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    return JobLayout(tmp_path / "job")


def test_hash_of_a_file_longer_than_the_buffer_is_blake3_of_its_bytes(tmp_path: Path) -> None:
    content = os.urandom(5 << 20)
    (tmp_path / "large").write_bytes(content)
    assert hash_file(tmp_path / "large") == blake3(content).hexdigest()


def test_an_artifact_without_its_receipt_counts_no_more(layout: JobLayout) -> None:
    commit(layout, SIMULATE, ARTIFACT, "ours")
    layout.receipt(ARTIFACT).unlink()
    assert layout.path(ARTIFACT).exists()
    assert not is_committed(layout, ARTIFACT, FINGERPRINT)


@pytest.mark.parametrize(
    ("damage", "finding"),
    [
        (lambda path: path.unlink(), "file is missing"),
        (lambda path: path.write_text(""), "file was edited or truncated: size 0, receipt says 8"),
        (lambda path: path.write_text("ouRs END"), "file was edited: its hash differs from the receipt's"),
    ],
)
def test_damage_is_found_by_size_time_and_hash(
    layout: JobLayout, damage: Callable[[Path], object], finding: str
) -> None:
    receipt = commit(layout, SIMULATE, ARTIFACT, "ours")
    damage(layout.path(ARTIFACT))
    assert verify_artifact(layout, receipt) == finding


def test_deep_verification_finds_a_flipped_bit_behind_an_unchanged_time(layout: JobLayout) -> None:
    receipt = commit(layout, SIMULATE, ARTIFACT, "ours")
    layout.path(ARTIFACT).write_text("ourt END")
    os.utime(layout.path(ARTIFACT), ns=(receipt.mtime_ns, receipt.mtime_ns))
    assert verify_artifact(layout, receipt) is None
    assert verify_artifact(layout, receipt, deep=True) == "file was edited: its hash differs from the receipt's"


@pytest.mark.parametrize("text", ["", "{", "[]", '{"artifact": "x"}', '{"unknown": 1}'])
def test_a_file_that_is_no_receipt_does_not_count(layout: JobLayout, text: str) -> None:
    commit(layout, SIMULATE, ARTIFACT, "ours")
    layout.receipt(ARTIFACT).write_text(text)
    assert read_receipt(layout, ARTIFACT) is None
    assert not is_committed(layout, ARTIFACT, FINGERPRINT)


def test_receipts_survive_their_text_form_and_a_changed_or_missing_seal_is_found(layout: JobLayout) -> None:
    receipt = replace(commit(layout, SIMULATE, ARTIFACT, "ours"), device="OPTIX: NVIDIA RTX 4090")
    text = receipt.to_json()
    assert Receipt.from_json(text) == receipt
    without = {key: value for key, value in json.loads(text).items() if key != "seal"}
    for damaged in (text.replace("4090", "4080"), json.dumps(without)):
        with pytest.raises(InvalidArtifactError, match="seal"):
            Receipt.from_json(damaged)
