"""Every path of a job, in one place."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.task import ArtifactPath, TaskId


@dataclass(frozen=True, slots=True)
class JobLayout:
    """The folder of a job. Artifact paths are relative to `root`, so the folder can be moved."""

    root: Path

    # --- files of the job itself ---
    @property
    def job_file(self) -> Path:
        """The job as submitted, overrides applied."""
        return self.root / "job.toml"

    @property
    def goal(self) -> Path:
        """The stages after which the job ends; not there if it ends with the film."""
        return self.root / "goal.json"

    @property
    def take_story(self) -> Path:
        """Description of a recording of `pipeline live`, beside its job file; its end adds the number of frames."""
        return self.root / "take.json"

    @property
    def manifest(self) -> Path:
        """The record of every task."""
        return self.root / "manifest.db"

    @property
    def lease(self) -> Path:
        """Lock file with the process that runs this job."""
        return self.root / "runner.lease"

    def is_of_lease(self, path: Path) -> bool:
        """Whether a path is the lease or its guard."""
        return path.parent == self.root and self.lease.name in path.name

    @property
    def receipts(self) -> Path:
        """Folder of all receipts."""
        return self.root / ".receipts"

    @property
    def provenance(self) -> Path:
        """Folder of the texts that receipts name by their digests."""
        return self.root / ".provenance"

    def job_text(self, digest: str) -> Path:
        """A job file that artifacts were made from."""
        return self.provenance / "jobs" / f"{digest}.toml"

    def parameters_text(self, digest: str) -> Path:
        """A parameter set that artifacts were made from."""
        return self.provenance / "parameters" / f"{digest}.json"

    def log(self, task_id: TaskId, attempt: int) -> Path:
        """Log of one attempt."""
        return self.root / "logs" / f"{task_id}.{attempt}.log"

    def receipt(self, artifact: ArtifactPath) -> Path:
        """Receipt of a committed artifact."""
        return self.receipts / f"{artifact}.json"

    def path(self, artifact: ArtifactPath) -> Path:
        """Path of an artifact."""
        return self.root / artifact

    @property
    def report(self) -> Path:
        """Report of timings and solvers, for people."""
        return self.root / "report.html"

    @property
    def preview_movie(self) -> Path:
        """A small film of the pictures that are there, while there is no whole one; no artifact."""
        return self.root / "movie-so-far.mp4"

    @property
    def preview_scratch(self) -> Path:
        """Folder of what the preview movie is made of, while a run makes it."""
        return self.root / ".so-far"

    @property
    def stills(self) -> Path:
        """Folder of single frames drawn otherwise than the film's; no artifacts."""
        return self.root / "stills"

    @property
    def inputs(self) -> Path:
        """Copies of the user's own files, such as meshes."""
        return self.root / "inputs"

    @property
    def poses(self) -> str:
        """Poses of the moving bodies at a frame, for Blender: path relative to the folder, with {frame}."""
        return "poses/{frame}.json"

    @property
    def views(self) -> str:
        """Pose of a moving camera at a frame, for Blender: path relative to the folder, with {frame}."""
        return "views/{frame}.json"

    def rejected_picture(self, frame: int) -> Path:
        """A picture that failed its checks twice, kept to be looked at."""
        return self.root / "rejected" / f"{frame:06d}.png"

    @property
    def checkpoints(self) -> Path:
        """Folder of the simulation's checkpoints."""
        return self.root / "cache" / "checkpoints"

    # --- artifacts ---
    @staticmethod
    def frame_cache(frame: int) -> ArtifactPath:
        """HDF5 snapshot of every body at one frame."""
        return ArtifactPath(f"cache/{frame:06d}.h5")

    @staticmethod
    def frame_bounds(frame: int) -> ArtifactPath:
        """Bounds of the bodies of one frame."""
        return ArtifactPath(f"bounds/{frame:06d}.json")

    @staticmethod
    def film_bounds() -> ArtifactPath:
        """Bounds of the whole film, for a camera that frames the action."""
        return ArtifactPath("bounds.json")

    @staticmethod
    def body_mesh(body: str, part: str = "body") -> ArtifactPath:
        """PLY mesh of a rigid body, or of a part of it, in its rest pose."""
        return ArtifactPath(f"meshes/{body}.ply" if part == "body" else f"meshes/{body}.{part}.ply")

    @staticmethod
    def product(folder: str, body: str, frame: int, suffix: str) -> ArtifactPath:
        """File of a body at one frame, for the renderer."""
        return ArtifactPath(f"{folder}/{body}/{frame:06d}{suffix}")

    @staticmethod
    def surface(body: str, frame: int) -> ArtifactPath:
        """PLY surface of a fluid at one frame."""
        return ArtifactPath(f"surfaces/{body}/{frame:06d}.ply")

    @staticmethod
    def volume(body: str, frame: int) -> ArtifactPath:
        """OpenVDB volume of a smoke at one frame."""
        return ArtifactPath(f"volumes/{body}/{frame:06d}.vdb")

    @staticmethod
    def whitewater(body: str, frame: int) -> ArtifactPath:
        """PLY points of a fluid's spray, foam and bubbles at one frame."""
        return ArtifactPath(f"whitewater/{body}/{frame:06d}.ply")

    @staticmethod
    def cloth(body: str, frame: int) -> ArtifactPath:
        """PLY mesh of a cloth at one frame."""
        return ArtifactPath(f"cloths/{body}/{frame:06d}.ply")

    @staticmethod
    def picture(frame: int) -> ArtifactPath:
        """Rendered frame."""
        return ArtifactPath(f"frames/{frame:06d}.png")

    @staticmethod
    def master(frame: int) -> ArtifactPath:
        """Rendered frame in linear light, with its passes."""
        return ArtifactPath(f"frames/{frame:06d}.exr")

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
