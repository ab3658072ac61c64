"""Every path of a job, in one place."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.task import ArtifactPath, TaskId


class _Below:
    """A path right below a job's folder, of the same name in every job."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, layout: JobLayout, _owner: type[JobLayout]) -> Path:
        return layout.root / self._name


def _of_frame(folder: str, suffix: str) -> Callable[[int], ArtifactPath]:
    """Where the artifacts of frames lie that share a folder, by the frame."""

    def path(frame: int) -> ArtifactPath:
        return ArtifactPath(f"{folder}/{frame:06d}{suffix}")

    return path


def _of_body(folder: str, suffix: str) -> Callable[[str, int], ArtifactPath]:
    """Where the artifacts of bodies at a frame lie, by body and frame."""

    def path(body: str, frame: int) -> ArtifactPath:
        return JobLayout.product(folder, body, frame, suffix)

    return path


@dataclass(frozen=True, slots=True)
class JobLayout:
    """The folder of a job. Artifact paths are relative to `root`, so the folder can be moved."""

    root: Path

    # --- files of the job itself ---
    job_file = _Below("job.toml")  # as submitted, overrides applied
    goal = _Below("goal.json")  # the stages after which the job ends; not there if it ends with the film
    siblings = _Below("siblings.json")  # of a job of a sweep: the others, which may have made the same
    recording_story = _Below("take.json")  # of a recording of `pipeline live`; its end adds the number of frames
    manifest = _Below("manifest.db")  # the record of every task
    lease = _Below("runner.lease")  # lock file with the process that runs this job
    receipts = _Below(".receipts")
    provenance = _Below(".provenance")  # texts that receipts name by their digests
    report = _Below("report.html")
    preview_movie = _Below("movie-so-far.mp4")  # of the pictures that are there, while there is no whole film
    preview_scratch = _Below(".so-far")  # what the preview movie is made of, while a run makes it
    stills = _Below("stills")  # single frames drawn with other settings than the film's; no artifacts
    logs_folder = _Below("logs")  # of attempts
    inputs = _Below("inputs")  # copies of the user's own files, such as meshes
    checkpoints = _Below("cache/checkpoints")

    poses = "poses/{frame}.json"  # poses of the moving bodies at a frame, for Blender: path relative to the folder
    views = "views/{frame}.json"  # pose of a moving camera at a frame, for Blender: path relative to the folder

    def is_of_lease(self, path: Path) -> bool:
        """Whether a path is the lease or its guard."""
        return path.parent == self.root and self.lease.name in path.name

    def job_text(self, digest: str) -> Path:
        """A job file that artifacts were made from."""
        return self.provenance / "jobs" / f"{digest}.toml"

    def parameters_text(self, digest: str) -> Path:
        """A parameter set that artifacts were made from."""
        return self.provenance / "parameters" / f"{digest}.json"

    def log(self, task_id: TaskId, attempt: int) -> Path:
        """Log of one attempt."""
        return self.logs_folder / f"{task_id}.{attempt}.log"

    def logs(self) -> Iterator[tuple[TaskId, int, Path]]:
        """Every log: of which task and attempt, and where it is."""
        for path in sorted(self.logs_folder.rglob("*.log")):
            task, _, number = path.relative_to(self.logs_folder).as_posix().removesuffix(".log").rpartition(".")
            if number.isdigit():
                yield TaskId(task), int(number), path

    def receipt(self, artifact: ArtifactPath) -> Path:
        """Receipt of a committed artifact."""
        return self.receipts / f"{artifact}.json"

    def path(self, artifact: ArtifactPath) -> Path:
        """Path of an artifact."""
        return self.root / artifact

    def rejected_picture(self, frame: int) -> Path:
        """A picture that failed its checks twice, kept to be looked at."""
        return self.root / "rejected" / f"{frame:06d}.png"

    # --- artifacts ---
    @staticmethod
    def product(folder: str, body: str, frame: int, suffix: str) -> ArtifactPath:
        """File of a body at one frame, for the renderer."""
        return ArtifactPath(f"{folder}/{body}/{frame:06d}{suffix}")

    frame_cache = staticmethod(_of_frame("cache", ".h5"))  # HDF5 snapshot of every body
    frame_bounds = staticmethod(_of_frame("bounds", ".json"))
    picture = staticmethod(_of_frame("frames", ".png"))
    master = staticmethod(_of_frame("frames", ".exr"))  # rendered frame in linear light, with its passes
    surface = staticmethod(_of_body("surfaces", ".ply"))
    liquid = staticmethod(_of_body("liquid", ".h5"))  # what each particle of a fluid stands for
    drops = staticmethod(_of_body("drops", ".ply"))  # points of what its spray breaks up into
    whitewater = staticmethod(_of_body("whitewater", ".ply"))  # points of a fluid's spray, foam and bubbles

    @staticmethod
    def film_bounds() -> ArtifactPath:
        """Bounds of the whole film, for a camera that frames the action."""
        return ArtifactPath("bounds.json")

    @staticmethod
    def body_mesh(body: str, part: str = "body") -> ArtifactPath:
        """PLY mesh of a rigid body, or of a part of it, in its rest pose; a group shares that of its model."""
        return ArtifactPath(f"meshes/{body}.ply" if part == "body" else f"meshes/{body}.{part}.ply")

    @staticmethod
    def segment(index: int, suffix: str = ".mp4") -> ArtifactPath:
        """A piece of the film; its suffix is that of `MovieParameters`."""
        return ArtifactPath(f"movie/{index:04d}{suffix}")

    @staticmethod
    def movie(suffix: str = ".mp4") -> ArtifactPath:
        """The film; its suffix is that of `MovieParameters`."""
        return ArtifactPath(f"movie{suffix}")

    @property
    def film(self) -> Path:
        """Path of the film, by the job file alone."""
        text = self.job_file.read_text(encoding="utf-8") if self.job_file.exists() else ""
        codec = tomllib.loads(text).get("movie", {}).get("codec")
        return self.path(self.movie(".mov" if codec == "prores" else ".mp4"))
