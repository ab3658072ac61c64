"""Committed frames of a job: those with a receipt, so that no file is opened while it is written."""

import time
from collections.abc import Iterable

from pipeline.base.files import stamp_of
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.rigid import meshes_at_rest
from pipeline.kinds.table import points_of
from pipeline.model.job import Job
from pipeline.store.receipts import Receipt, of_newest, read_receipt

FileStamp = tuple[int, int, int]
"""As `stamp_of` has it."""
Stamp = tuple[FileStamp | None, ...]
"""Stamps of receipts; None where there is none. It differs when one of them was replaced."""

SETTLED_NS = 2_000_000_000
"""File systems tell times to two seconds at worst."""


class CommittedFrames:
    """The frames that a simulation has committed, looked at again and again while it goes on.

    Frames of an earlier version of the simulation do not count. `folder` is that of their receipts.
    """

    def __init__(self, layout: JobLayout) -> None:
        self._layout = layout
        self.folder = layout.receipt(layout.frame_cache(0)).parent
        self._folder_stamp: FileStamp | None = None
        self._seen: dict[int, tuple[FileStamp, Receipt | None]] = {}
        self._receipts: dict[int, Receipt] = {}

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the frames that are there, ascending."""
        return tuple(self._receipts)

    def receipt(self, frame: int) -> Receipt:
        """The receipt of a frame that is there."""
        return self._receipts[frame]

    def update(self) -> bool:
        """Look again; returns whether frames have come, gone or been replaced. Reads only receipts that are new."""
        folder_stamp = stamp_of(self.folder)
        if folder_stamp is not None and time.time_ns() - folder_stamp[1] <= SETTLED_NS:
            folder_stamp = None  # another receipt may come at the same time of the file system's clock
        if folder_stamp is not None and folder_stamp == self._folder_stamp:
            return False
        seen: dict[int, tuple[FileStamp, Receipt | None]] = {}
        for path in sorted(self.folder.glob("[0-9]*.h5.json")):
            frame, stamp = int(path.name.removesuffix(".h5.json")), stamp_of(path)
            if stamp is None:
                continue
            before = self._seen.get(frame)
            if before is None or before[0] != stamp:
                before = stamp, read_receipt(self._layout, self._layout.frame_cache(frame))
            seen[frame] = before
        self._folder_stamp = folder_stamp  # only now: what could not be read is tried again
        if seen == self._seen:
            return False
        self._seen = seen
        receipts = {frame: receipt for frame, (_, receipt) in seen.items() if receipt is not None}
        self._receipts = of_newest(receipts)
        return True

    def bounds_are_known(self, job: Job, frame: int) -> bool:
        """Whether the film's bounds are there, and not those of an earlier simulation: of this frame and the last one.

        They are made when the whole film is simulated, from bounds of each frame, and those from the cached frames.
        """
        film = read_receipt(self._layout, self._layout.film_bounds())
        fingerprints = set()
        for number in (frame, job.frame_count - 1):
            own = read_receipt(self._layout, self._layout.frame_bounds(number))
            cached = read_receipt(self._layout, self._layout.frame_cache(number))
            if film is None or own is None or cached is None or own.inputs.get(cached.artifact) != cached.hash:
                return False
            if film.inputs.get(own.artifact) != own.hash:
                return False
            fingerprints.add(cached.fingerprint)
        return len(fingerprints) == 1

    def derived(self, frame: int, artifact: ArtifactPath) -> bool:
        """Whether a file that is made from a frame is there, and was made from the frame as it is now."""
        receipt, cached = (read_receipt(self._layout, each) for each in (artifact, self._layout.frame_cache(frame)))
        return receipt is not None and cached is not None and receipt.inputs.get(cached.artifact) == cached.hash

    def is_there(self, artifact: ArtifactPath) -> bool:
        """Whether a file that does not depend on frames is committed."""
        return read_receipt(self._layout, artifact) is not None

    def stamp(self, artifacts: Iterable[ArtifactPath]) -> Stamp:
        """A stamp that changes when any of these files is committed anew."""
        return tuple(stamp_of(self._layout.receipt(artifact)) for artifact in artifacts)


def artifacts_of_frame(job: Job, layout: JobLayout, frame: int | None) -> list[ArtifactPath]:
    """All files that a frame is shown from; None: those that belong to no frame."""
    artifacts = [*meshes_at_rest(job.rigid)]
    if frame is None:
        return artifacts
    artifacts.append(layout.frame_cache(frame))
    artifacts += [layout.surface(fluid.name, frame) for fluid in job.fluid]
    artifacts += points_of(job, layout, frame)
    if job.camera.frames_action:
        last = job.frame_count - 1
        artifacts += [layout.film_bounds(), layout.frame_bounds(frame), layout.frame_bounds(last)]
        artifacts.append(layout.frame_cache(last))
    return artifacts
