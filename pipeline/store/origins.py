"""Origins of artifacts, by their receipts, in words."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from pipeline.base import wording
from pipeline.base.layout import JobLayout
from pipeline.store.provenance import read_text
from pipeline.store.receipts import Receipt


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of a group of a task's artifacts: the same job file, parameters, attempt and machine."""

    receipt: Receipt  # one of theirs
    artifacts: int  # how many they are
    job_file: str | None  # where the job file lies that they were made from; None if it was not kept
    tools: dict[str, str] | None  # versions of the stage and of its tools; None if the parameters were not kept

    def lines(self) -> Iterator[str]:
        """For people."""
        receipt = self.receipt
        count = wording.counted(self.artifacts, "file")
        yield f"origin  {count} by attempt {receipt.attempt} on {receipt.host}, {wording.moment(receipt.finished)}"
        if receipt.maker:
            yield f"        {receipt.maker}"
        if receipt.device:
            yield f"        drawn on {receipt.device}"
        if self.tools is not None:
            tools = ", ".join(f"{name} {version}" for name, version in self.tools.items())
            yield f"        versions: {tools}"
        yield f"        job file: {self.job_file or 'not kept'}"
        key, fingerprint = receipt.parameters[:16], receipt.fingerprint[:16]
        yield f"        parameters {key}, {len(receipt.inputs)} inputs, together the fingerprint {fingerprint}"

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        return {
            "artifacts": self.artifacts,
            "attempt": self.receipt.attempt,
            "host": self.receipt.host,
            "device": self.receipt.device,
            "maker": self.receipt.maker,
            "finished": self.receipt.finished,
            "job": self.receipt.job,
            "job_file": self.job_file,
            "parameters": self.receipt.parameters,
            "versions": self.tools,
            "inputs": self.receipt.inputs,
        }


def origins_of(layout: JobLayout, receipts: Sequence[Receipt]) -> list[Origin]:
    """Origins of a task's artifacts, latest last; those that have it in common together."""
    in_common = attrgetter("attempt", "host", "maker", "device", "job", "parameters", "fingerprint")
    groups: dict[object, list[Receipt]] = {}
    for receipt in receipts:
        groups.setdefault(in_common(receipt), []).append(receipt)
    latest_last = sorted(groups.values(), key=lambda members: members[-1].finished)
    return [_origin(layout, members[-1], len(members)) for members in latest_last]


def _origin(layout: JobLayout, receipt: Receipt, artifacts: int) -> Origin:
    job_file = layout.job_text(receipt.job)
    kept = bool(receipt.job) and read_text(job_file) is not None
    canonical = read_text(layout.parameters_text(receipt.parameters))
    tools = None
    if canonical is not None:
        values = json.loads(canonical)
        tools = {f"stage {values['stage_name']}": str(values["stage_version"]), **values["tools"]}
    return Origin(
        receipt=receipt,
        artifacts=artifacts,
        job_file=job_file.relative_to(layout.root).as_posix() if kept else None,
        tools=tools,
    )
