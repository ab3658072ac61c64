"""How many particles the whitewater of each frame has, and how many had no room, as its files' headers tell."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.run.plan import frame_ranges
from pipeline.store.receipts import Receipt, read_receipt
from sim.core.solver import Diagnostics

WHITEWATER = "whitewater"
"""The stage whose artifacts are these files."""


class WhitewaterParts(NamedTuple):
    """Which fluid's whitewater a file is, and of which frame."""

    fluid: str
    frame: int

    @property
    def teller(self) -> str:
        """What its numbers are listed under, beside those of the solvers."""
        return f"whitewater of {self.fluid}"


@dataclass(slots=True)
class WhitewaterNumbers:
    """Of all files that belong to the present frames of the cache.

    Attributes:
        frames: numbers by frame, then by what makes them, named like a solver.
        unreadable: files that were committed and cannot be read any more.
    """

    frames: dict[int, dict[str, Diagnostics]] = field(default_factory=dict)
    unreadable: list[ArtifactPath] = field(default_factory=list)


def whitewater_numbers(layout: JobLayout, cached: Mapping[int, Receipt], fluids: Collection[str]) -> WhitewaterNumbers:
    """The numbers of all whitewater that was made from these frames, with the parameters of the newest.

    Args:
        layout: the job's folder.
        cached: receipts of the cache's frames; whitewater of others is that of an earlier version.
        fluids: that have whitewater; files of others are left over from an earlier version of the job.
    """
    found = WhitewaterNumbers()
    for fluid in sorted(fluids):
        for receipt in _of_newest_parameters(_receipts(layout, fluid)):
            parts = parts_of(receipt.artifact)
            frame = cached.get(parts.frame)
            if frame is None or receipt.inputs.get(frame.artifact) != frame.hash:
                continue
            try:
                numbers = read_whitewater_numbers(layout, receipt.artifact)
            except InvalidArtifactError:
                found.unreadable.append(receipt.artifact)
            else:
                found.frames.setdefault(parts.frame, {})[parts.teller] = numbers
    return found


def unreadable_whitewater(files: Iterable[ArtifactPath]) -> list[str]:
    """`whitewater of water that cannot be read: frames 3, 7-9`, a sentence for each fluid."""
    frames: dict[str, list[int]] = {}
    for parts in map(parts_of, files):
        frames.setdefault(parts.teller, []).append(parts.frame)
    return [
        f"{teller} that cannot be read: frame{'s' if len(of) > 1 else ''} {frame_ranges(of, range(max(of) + 1))}"
        for teller, of in frames.items()
    ]


def read_whitewater_numbers(layout: JobLayout, artifact: ArtifactPath) -> Diagnostics:
    """The numbers of one file.

    Raises:
        InvalidArtifactError: it cannot be read.
    """
    from render.errors import InvalidFileError
    from render.point_clouds import read_point_counts

    try:
        counts = read_point_counts(layout.path(artifact))
    except (OSError, InvalidFileError) as error:
        raise InvalidArtifactError(f"{artifact}: its header cannot be read: {error}") from error
    capped = {} if counts.not_made is None else {"whitewater_capped": float(counts.not_made)}
    return {"whitewater_particles": float(counts.points), **capped}


def parts_of(artifact: ArtifactPath) -> WhitewaterParts:
    """Fluid and frame of a file, by its path."""
    _, fluid, name = artifact.split("/")
    return WhitewaterParts(fluid, int(name.removesuffix(".ply")))


def _receipts(layout: JobLayout, fluid: str) -> list[Receipt]:
    artifacts = (
        layout.whitewater(fluid, int(path.name.removesuffix(".ply.json")))
        for path in sorted((layout.receipts / WHITEWATER / fluid).glob("[0-9]*.ply.json"))
    )
    return [receipt for receipt in (read_receipt(layout, artifact) for artifact in artifacts) if receipt]


def _of_newest_parameters(receipts: Collection[Receipt]) -> list[Receipt]:
    """Those that were made like the newest: other rates or speeds make other numbers, of frames that are to be redone.

    Fingerprints do not tell that, as each frame has its own.
    """
    newest = max(receipts, key=lambda receipt: receipt.finished, default=None)
    return [receipt for receipt in receipts if newest is not None and receipt.parameters == newest.parameters]
