"""How many particles the whitewater of each frame has, and how many had no room, as its files' headers tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pipeline.artifacts import Receipt, read_receipt
from pipeline.errors import InvalidArtifactError
from pipeline.layout import JobLayout
from pipeline.task import ArtifactPath
from sim.solver import Diagnostics

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


def whitewater_numbers(layout: JobLayout, cached: Mapping[int, Receipt]) -> WhitewaterNumbers:
    """The numbers of all whitewater that was made from these frames.

    Args:
        layout: the job's folder.
        cached: receipts of the cache's frames; whitewater of others is that of an earlier version.
    """
    found = WhitewaterNumbers()
    for path in sorted(layout.receipts.glob(f"{WHITEWATER}/*/[0-9]*.ply.json")):
        artifact = ArtifactPath(path.relative_to(layout.receipts).as_posix().removesuffix(".json"))
        parts = parts_of(artifact)
        frame = parts.frame
        receipt = read_receipt(layout, artifact)
        if receipt is None or frame not in cached:
            continue
        if receipt.inputs.get(layout.frame_cache(frame)) != cached[frame].hash:
            continue
        try:
            found.frames.setdefault(frame, {})[parts.teller] = read_whitewater_numbers(layout, artifact)
        except InvalidArtifactError:
            found.unreadable.append(artifact)
    return found


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
    return {"whitewater_particles": float(counts.points), "whitewater_capped": float(counts.not_made)}


def parts_of(artifact: ArtifactPath) -> WhitewaterParts:
    """Fluid and frame of a file, by its path."""
    _, fluid, name = artifact.split("/")
    return WhitewaterParts(fluid, int(name.removesuffix(".ply")))
