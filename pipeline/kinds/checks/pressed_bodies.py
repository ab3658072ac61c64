"""Checks of bodies that would float, but start flush on the domain's floor under a fluid."""

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import ALL, touch
from pipeline.model.job import Job
from pipeline.model.problems import Findings

LEAST_COSINE = 0.97  # of the angle between gravity and the normal of an underside that counts as flat: 14 degrees


def check_pressed_bodies(job: Job, solids: Solids, findings: Findings) -> None:
    """Warn of bodies lighter than a fluid that it does not lift, as no particle fits under them.

    A particle needs a gap of its spacing. Under a flat part of the body's underside that is nearer to the floor there
    is no pressure, and that above, of the depth, has no counterpart. What keeps a box down lets a ball go.
    """
    gravity = np.asarray(job.gravity, dtype=np.float64)
    if not job.fluid or not gravity.any():
        return
    down = int(np.abs(gravity).argmax())
    sign = float(np.sign(gravity[down]))
    if f"{'xyz'[down]}{'+' if sign > 0.0 else '-'}" in job.domain.open_faces:
        return
    floor = float((job.domain.max if sign > 0.0 else job.domain.min)[down])
    spacing = job.fluid[0].spacing
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if body.kind != "dynamic" or body.density is None or solid is None:
            continue
        gap = float((sign * (floor - solid.bounds[:, down])).min())
        if gap >= ALL * spacing:
            continue
        mass = body.density * solid.volume + sum(ballast.mass for ballast in body.ballast)
        mesh = solid.surface_mesh()
        areas, heights = mesh.area_vectors, sign * (floor - mesh.corners[:, :, down])
        facing = sign * areas[:, down]
        is_flat = facing > LEAST_COSINE * np.linalg.norm(areas, axis=1)
        dry = float((facing * _share_below(spacing, heights))[is_flat].sum())
        for path, block in solids.items():
            if path[0] != "fluid" or not touch(block.bounds, solid.bounds, margin=spacing):
                continue
            fluid = job.fluid[int(path[1])]
            depth = float((sign * (floor - block.bounds[:, down])).max()) - gap
            immersed = solid.volume * min(1.0, depth / float(np.ptp(solid.bounds[:, down])))
            if mass < fluid.rest_density * immersed < mass + fluid.rest_density * depth * dry:
                findings.warn(
                    ("rigid", index, "position"),
                    f'is lighter than the "{fluid.name}" around it, but stays on the floor: the {gap:.3g} m under it '
                    f"are less than the {spacing:.3g} m of a particle, so that nothing presses on {dry:.2g} m² of its "
                    f"flat underside, and {depth:.3g} m of fluid on what is above; start it {spacing:.3g} m above the "
                    "floor" + (f", or use particle_radius {rounded_down(0.5 * gap):g} m" if gap > 0.0 else ""),
                )
                break


def _share_below(level: float, heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the area of triangles below a level [-], (n,), by the heights of their corners, (n, 3)."""
    low, middle, high = np.sort(heights, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        up_to_middle = (level - low) ** 2 / ((middle - low) * (high - low))
        from_middle = 1.0 - (high - level) ** 2 / ((high - low) * (high - middle))
    return np.select([level >= high, level <= low, level < middle], [1.0, 0.0, up_to_middle], from_middle)
