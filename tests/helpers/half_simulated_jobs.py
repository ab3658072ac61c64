"""A job of which some frames are simulated, none is drawn, and what it has is on receipt."""

from pathlib import Path

from drawn_jobs import job_of_the_ball, pose

from pipeline.base.layout import JobLayout
from pipeline.base.task import task_fingerprint
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.store.artifacts import committing
from pipeline.store.cache import write_frame
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

FRAMES_SIMULATED = 2


def half_simulated_job(folder: Path, more: str = "") -> JobLayout:
    """Three frames of a ball that flies, of which two are simulated; with more tables in its file."""
    job, layout = job_of_the_ball(folder, "flight", more)
    layout.manifest.touch()
    for task in plan_job(job, layout, STAGES):
        if task.stage not in ("bodies", "simulate"):
            continue
        for frame, artifact in enumerate(task.outputs):
            if task.stage == "simulate" and frame >= FRAMES_SIMULATED:
                continue
            content = None if task.stage == "simulate" else layout.path(artifact).read_bytes()
            with committing(
                layout,
                artifact,
                task=task,
                attempt=1,
                fingerprint=task_fingerprint(task, {}),
                validate=lambda _path: None,
            ) as commit:
                if content is not None:
                    commit.path.write_bytes(content)
                    continue
                ball = Snapshot("rigid", pose((0.2 * frame, 0.0, 0.5), velocity=(12.0, 0.0, 0.0))["ball"], {})
                report = FrameReport(frame, frame / 60, {}, {}, {})
                write_frame(commit.path, {"ball": ball}, report, device="cpu")
    return layout
