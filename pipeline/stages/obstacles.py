"""What spray and whitewater read of the cache: fluids, and the bodies that they must not enter."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.kinds.rigid import is_animated
from pipeline.model.job import Job
from pipeline.store.cache import read_frame
from sim.core.snapshots import Snapshot
from sim.shapes.parameters import Placement

if TYPE_CHECKING:
    from sim.shapes.level_set import LevelSet
    from sim.whitewater.obstacles import MovingObstacle


def read_fluids_and_bodies(path: Path) -> dict[str, Snapshot]:
    """Fluids and rigid bodies of a cached frame; smoke would take longer than all of it."""
    return {**read_frame(path, kind="rigid").bodies, **read_frame(path, kind="fluid").bodies}


def moving_obstacles(
    job: Job, before: Mapping[str, Snapshot], now: Mapping[str, Snapshot], particle_radius: float
) -> list[MovingObstacle]:
    """The rigid bodies between two frames, for a fluid of this particle radius [m]."""
    from sim.whitewater.obstacles import MovingObstacle, Pose, deformed

    return [
        deformed(before[body.name], now[body.name], particle_radius)
        if is_animated(body)
        else MovingObstacle(
            _level_set(Placement(shape=body.shape, scale=body.scale).model_dump_json(), particle_radius),
            Pose.of_snapshot(before[body.name]),
            Pose.of_snapshot(now[body.name]),
        )
        for body in job.rigid
    ]


@cache
def _level_set(placement: str, particle_radius: float) -> LevelSet:
    """Distances of a shape, its placement given as JSON; kept, as sampling a mesh takes longer than a frame."""
    from sim.whitewater.obstacles import sample_at_rest

    return sample_at_rest(Placement.model_validate_json(placement), particle_radius)
