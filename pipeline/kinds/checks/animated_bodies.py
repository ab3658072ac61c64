"""Checks of bodies that files animate: what of the film their samples cover, and walls that contacts can feel."""

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.model.job import Job
from pipeline.model.problems import Findings, Problem
from sim.shapes.animation import AnimatedSolid
from sim.shapes.deformation import GRID_CELLS
from sim.shapes.distance_grids import CELLS_PER_WALL, THIN_SHARE, wall_thickness
from sim.shapes.parameters import AnimationShape
from sim.shapes.solid import TriangleMesh

# Times its usual distance that samples of a fluid's boundary may be apart; and part of a surface that may be worse.
STRETCHED, WORTH_A_WARNING = 1.5, 0.02
# Share of a frame by which samples may end before the film: times of files are rounded.
ROUND_OFF = 1.0e-3


def check_animated_bodies(job: Job, solids: Solids, findings: Findings) -> None:
    """Tell of each animated body which samples it has, and note what they do not cover and what is too thin."""
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if not isinstance(body.shape, AnimationShape) or solid is None:
            continue
        shape = solid.shape
        assert isinstance(shape, AnimatedSolid), "an animation is built as one"
        begin_s, end_s = body.shape.start_s, body.shape.start_s + shape.duration_s
        path = ("rigid", index, "shape")
        how = "moves" if shape.deformed is None else "moves and deforms"
        findings.facts.append(
            Problem(
                path,
                f'{how} "{body.name}" by {len(shape.times)} samples from {begin_s:.4g} to {end_s:.4g} s, with '
                f"{len(shape.mesh.faces):,} triangles",
            )
        )
        last_s = (job.frame_count - 1) / job.fps
        still = [
            *([f"before {begin_s:.4g} s"] if begin_s > 0.0 else []),
            *([f"after {end_s:.4g} s"] if end_s < last_s - ROUND_OFF / job.fps else []),
        ]
        if still:
            findings.warn(path, f"is held still {' and '.join(still)}, where its file has no samples")
        if shape.deformed is not None:
            _check_walls(job, index, shape, solid.scale, findings)
            if job.fluid:
                _check_stretch(index, shape, findings)


def _check_stretch(index: int, shape: AnimatedSolid, findings: Findings) -> None:
    """Note a surface that is stretched elsewhere than where it is largest: samples spread there are too far apart."""
    assert shape.deformed is not None, "only meshes that deform are stretched"
    areas = np.stack(
        [
            np.linalg.norm(TriangleMesh(points.astype(np.float64), shape.mesh.faces).area_vectors, axis=1)
            for points in shape.deformed
        ]
    )
    widest = areas[np.argmax(areas.sum(axis=1))]
    largest, number = areas.max(axis=0), areas.argmax(axis=0)
    is_stretched = largest > STRETCHED**2 * widest
    share = float(largest[is_stretched].sum() / largest.sum())
    if share > WORTH_A_WARNING:
        worst = int(np.argmax(np.where(is_stretched, largest - widest, 0.0)))
        findings.warn(
            ("rigid", index, "shape"),
            f"stretches {share:.0%} of its surface to more than {STRETCHED:g} times its width in the sample where it "
            f"is largest, most at {shape.times[number[worst]]:.4g} s after its first: fluid may leak in there; stretch "
            "it less, or animate its parts as bodies of their own (shape.object)",
        )


def _check_walls(job: Job, index: int, shape: AnimatedSolid, scale: float, findings: Findings) -> None:
    """Note walls that the grid of a mesh that deforms is too coarse for."""
    if not job.cloth and not job.smoke and not any(body.kind == "dynamic" for body in job.rigid):
        return
    assert shape.deformed is not None, "only meshes that deform have such a grid"
    cell = scale * float(np.ptp(shape.deformed.reshape(-1, 3), axis=0).max()) / GRID_CELLS
    wall = scale * wall_thickness(shape, THIN_SHARE)
    if wall < CELLS_PER_WALL * cell:
        findings.warn(
            ("rigid", index, "shape"),
            f"deforms with walls of {wall:.3g} m or thinner on {THIN_SHARE:.0%} of its surface or more; bodies, cloth "
            f"and smoke meet it by a grid with cells of {cell:.3g} m and feel walls of {CELLS_PER_WALL:g}: they may "
            "pass through; make them thicker, or animate its parts as bodies of their own (shape.object)",
        )
