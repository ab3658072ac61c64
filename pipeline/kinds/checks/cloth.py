"""Checks of cloths: sheets, and the places where they start."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.cloth_bodies import check_bodies_for_cloth
from pipeline.kinds.checks.cloth_fluid import check_buoyancy, fluid_over
from pipeline.kinds.checks.cloth_joints import check_joints_of_cloth
from pipeline.kinds.checks.cloth_start import ClothStart, start_cloths
from pipeline.kinds.checks.joints import joined_to
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.pins import check_pin_load, check_pin_speeds, check_pin_times
from pipeline.model.amounts import count
from pipeline.model.boxes import Box, domain_box, span, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import RUNAWAY_SPEED, ClothParameters, RectangleSheet, shared_conflicts
from sim.cloth.springs import ACCURATE_SHARE, cells_of, longest_explicit_step, springs_of, too_few_substeps
from sim.cloth.start import TOUCHING, first_crossing, reach_of, too_coarse_positions
from sim.core.domain import DomainParameters
from sim.core.world import MAX_SUBSTEPS_PER_FRAME
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import Solid

# A mesh so many times as large as the domain is in other units, most likely.
VAST = 20.0
# Depth in a body of cloth that is laid onto it, in decimal numbers [m].
ROUND_OFF = 1.0e-6
# Nodes within the thickness of one, on average; each pair has some seven contacts.
MOST_NEIGHBOURS = 300
# Triangles that are divided further to find what they reach into.
MOST_DIVIDED = 100_000
# Substeps of explicit springs in a frame: 150 times as many as XPBD takes.
MANY_SUBSTEPS = 3000


def check_cloths(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with the cloths; returns the nodes of all that can be built."""
    for number, key, message in shared_conflicts(job.cloth):
        findings.error(("cloth", number, key), message)
    for number, cloth in enumerate(job.cloth):
        check_pin_times(("cloth", number), cloth, job.film_s, findings)
        _check_speeds(("cloth", number), cloth, findings)
        _check_wind_in_smoke(job, ("cloth", number), cloth, findings)
    starts = start_cloths(job, budget, findings)
    reach = reach_of(job.domain, np.concatenate([np.zeros((0, 3)), *(start.position for start in starts)]))
    for number, start in enumerate(starts):
        _check_place(start, job.domain, findings)
        if reason := too_coarse_positions(start.cloth, start.position, reach):
            findings.error(start.path, reason)
        _check_size(start, job.domain, findings)
        _check_spacing(start, findings)
        check_pin_speeds(start, job, findings)
        check_pin_load(start, job, fluid_over(job, solids, start.box), findings)
        check_buoyancy(job, start.path, start.cloth, findings)
        check_joints_of_cloth(start, job, findings)
        joined = joined_to(start.cloth, job)
        for path, solid in solids.items():
            if path[0] == "rigid" and job.rigid[int(path[1])].name not in joined:
                _check_inside(start, job.rigid[int(path[1])].name, solid, findings)
        _check_crossings(start, starts[:number], findings)
    _check_substeps([start for start in starts if start.cloth.integrator == "explicit"], job.fps, findings)
    if starts:
        check_bodies_for_cloth(job, solids, starts, findings)
    return sum(len(start.position) for start in starts)


def _check_place(start: ClothStart, domain: DomainParameters, findings: Findings) -> None:
    """Refuse cloth out of sight, and cloth on both sides of a wall."""
    box = domain_box(domain)
    if not touch(start.box, box, margin=0.0):
        findings.error(start.path, f"is wholly outside the domain: it spans {span(start.box)}, not {span(box)}")
        return
    free = start.position[~start.held]
    for axis, letter in enumerate("xyz"):
        for sign, beyond in (("-", box[0, axis] - free[:, axis]), ("+", free[:, axis] - box[1, axis])):
            if f"{letter}{sign}" not in domain.open_faces and beyond.max(initial=0.0) > ROUND_OFF:
                findings.error(
                    start.path,
                    f"passes through the wall {letter}{sign}, as at {_place(free[beyond.argmax()])}; move it, or name "
                    "the face in domain.open_faces",
                )


def _check_speeds(path: KeyPath, cloth: ClothParameters, findings: Findings) -> None:
    """Refuse speeds at which the simulation stops; warn of wind that blows through the cloth."""
    for key in ("velocity", "wind"):
        if (speed := math.hypot(*getattr(cloth, key))) >= RUNAWAY_SPEED:
            findings.error((*path, key), f"must be below {RUNAWAY_SPEED:g} m/s, got {speed:g} m/s; units are SI")
    if any(cloth.wind) and not cloth.air_density * (cloth.drag + cloth.skin_drag) > 0.0:
        none = "air_density" if not cloth.air_density else "drag and skin_drag"
        findings.warn((*path, "wind"), f"has no effect without {none}; give that a value, or remove the wind")


def _check_wind_in_smoke(job: Job, path: KeyPath, cloth: ClothParameters, findings: Findings) -> None:
    for smoke in job.smoke:
        lower, upper = smoke.corners(job.domain)
        starts_inside = all(a <= x <= b for a, x, b in zip(lower, cloth.position, upper, strict=True))
        if any(cloth.wind) and cloth.wind != smoke.wind and starts_inside:
            findings.warn(
                (*path, "wind"),
                f'does not blow in the box of smoke "{smoke.name}", where the cloth starts: the air of the smoke moves '
                "it there; give the smoke that wind, or another box",
            )


def _check_size(start: ClothStart, domain: DomainParameters, findings: Findings) -> None:
    """A mesh in millimetres is a thousand times too large; with open faces no other check would find it."""
    largest, room = float(np.ptp(start.box, axis=0).max()), float(np.ptp(domain_box(domain), axis=0).max())
    if isinstance(start.cloth.shape, MeshShape) and largest > VAST * room:
        findings.warn(
            (*start.path, "shape", "file"),
            f"is {largest:.4g} m across, the domain {room:.4g} m; files have no unit and are read in metres: "
            "give shape.size",
        )


def _check_spacing(start: ClothStart, findings: Findings) -> None:
    """Layers keep the thickness where the sheet is folded; it cannot fold more sharply than its nodes allow."""
    shortest, thickness = start.shortest_edge, start.cloth.thickness
    if not start.cloth.self_collision or thickness <= shortest:
        return
    tree = cKDTree(start.sheet.vertices)
    neighbours = float(tree.count_neighbors(tree, thickness)) / len(start.position) - 1.0
    if neighbours > MOST_NEIGHBOURS:
        mean = math.sqrt(float(start.sheet.node_area.mean()))
        findings.error(
            (*start.path, "thickness"),
            f"{thickness:g} m is so much more than the {mean:.3g} m between nodes that {neighbours:.0f} of them are "
            f"within it of each, {MOST_NEIGHBOURS} at most; make it thinner, the sheet coarser, or use "
            "self_collision = false",
        )
    else:
        findings.warn(
            (*start.path, "thickness"),
            f"{thickness:g} m is more than the {shortest:.3g} m between neighbouring nodes: every node is "
            "in contact with many others, which takes long; make it thinner, or the sheet coarser",
        )


def _check_substeps(starts: Sequence[ClothStart], fps: int, findings: Findings) -> None:
    """Explicit springs are unstable beyond their step, and without a number of substeps dictate theirs.

    Cloths step together, as often as the one that takes most.
    """
    longest = [_longest_step(start) for start in starts]
    taken = [
        start.cloth.substeps or math.ceil(1.0 / (fps * ACCURATE_SHARE * step))
        for start, step in zip(starts, longest, strict=True)
    ]
    for start, step, substeps in zip(starts, longest, taken, strict=True):
        if start.cloth.substeps is not None:
            if reason := too_few_substeps(max(taken), 1.0 / fps, step):
                findings.error((*start.path, "substeps"), reason)
            continue
        takes = f'"explicit" takes {count(substeps)} substeps a frame of springs of this stiffness and mass'
        helps = 'give a softer stretch_stiffness or a coarser sheet, or use "xpbd"'
        if substeps > MAX_SUBSTEPS_PER_FRAME:
            most = count(MAX_SUBSTEPS_PER_FRAME)
            findings.error((*start.path, "integrator"), f"{takes}, more than the {most} at which a run ends: {helps}")
        elif substeps > MANY_SUBSTEPS:
            findings.warn((*start.path, "integrator"), f"{takes}, which takes long: {helps}")


def _longest_step(start: ClothStart) -> float:
    """Longest step that is stable for the explicit springs of a cloth [s]."""
    cloth = start.cloth
    families = [
        (springs, (1.0 + cloth.poisson_ratio) * springs.stiffness(cloth), springs.damping(cloth))
        for springs in springs_of(start.sheet)
    ]
    # Nodes that are released later need shorter steps from then on.
    inverse_mass = np.where(start.held_for_ever, 0.0, 1.0 / (start.sheet.node_area * cloth.mass_per_area))
    cells = cells_of(start.sheet)
    return longest_explicit_step(families, [(cells, cells.law(cloth))], inverse_mass)


def _check_inside(start: ClothStart, body: str, solid: Solid, findings: Findings) -> None:
    """Refuse cloth in a body: nobody knows which way out is meant. Pinned nodes stay where they are, so they may be."""
    if not touch(start.box, solid.bounds, margin=0.0):
        return
    free = [start.position[parts[~start.held[parts].any(axis=1)]] for parts in (start.edges, start.sheet.triangles)]
    points = np.concatenate([start.position[~start.held], free[0].mean(axis=1)])
    points = points[((points >= solid.bounds[0]) & (points <= solid.bounds[1])).all(axis=1)]
    inside = points[solid.signed_distance(points) < -ROUND_OFF] if len(points) else points
    if not len(inside):
        inside = _points_inside(free[1][_reaching(free[1], solid.bounds)], solid, finest=start.cloth.thickness)
    if len(inside):
        findings.error(start.path, f'starts inside "{body}", as at {_place(inside[0])}; move one of them')


def _points_inside(triangles: NDArray[np.float64], solid: Solid, *, finest: float) -> NDArray[np.float64]:
    """Middles of triangles (m, 3, 3), or of parts of them down to the `finest` [m], in a solid [m], (n, 3).

    Parts whose middle is farther off than their corners are from it cannot reach into the solid.
    """
    while len(triangles):
        middle = triangles.mean(axis=1)
        distance = solid.signed_distance(middle)
        radius = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
        parts = triangles[(distance < radius) & (radius > finest)]
        if (distance < -ROUND_OFF).any() or len(parts) > MOST_DIVIDED:
            inside: NDArray[np.float64] = middle[distance < -ROUND_OFF]
            return inside
        half = 0.5 * (parts + np.roll(parts, -1, axis=1))  # the middles of the sides from each corner on
        corners = [np.stack([parts[:, k], half[:, k], half[:, k - 1]], axis=1) for k in range(3)]
        triangles = np.concatenate([half, *corners])
    return np.zeros((0, 3))


def _check_crossings(start: ClothStart, earlier: Sequence[ClothStart], findings: Findings) -> None:
    """Refuse cloth that passes through another or touches it, or a mesh itself.

    Contacts keep what crosses crossed, and what touches has no side to be kept on.
    """
    if start.cloth.self_collision and not isinstance(start.cloth.shape, RectangleSheet):
        point = first_crossing(start.position, start.edges, start.sheet.triangles)
        if point is not None:
            findings.error(
                (*start.path, "shape"),
                f"passes through or touches itself at {_place(point)}; take it apart by its thickness, or use "
                "self_collision = false",
            )
    for other in earlier:
        if not touch(start.box, other.box, margin=TOUCHING):
            continue
        points = (_crossing_of(one, two) for one, two in ((start, other), (other, start)))
        point = next((each for each in points if each is not None), None)
        if point is not None:
            findings.error(
                start.path,
                f'passes through or touches cloth "{other.cloth.name}" at {_place(point)}; move one of them, '
                f"{max(start.cloth.thickness, other.cloth.thickness):g} m or more apart",
            )


def _crossing_of(one: ClothStart, other: ClothStart) -> NDArray[np.float64] | None:
    """Where an edge of one cloth passes through or touches a triangle of another [m]."""
    position = np.concatenate([one.position, other.position])
    margin = np.array([[-TOUCHING], [TOUCHING]])
    edges = one.edges[_reaching(one.position[one.edges], other.box + margin)]
    triangles = other.sheet.triangles[_reaching(other.position[other.sheet.triangles], one.box + margin)]
    return first_crossing(position, edges, triangles + len(one.position))


def _reaching(corners: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    """Which elements, with corners (m, c, 3), have a box that touches another one, (m,)."""
    reaching: NDArray[np.bool_] = ((corners.max(axis=1) >= box[0]) & (corners.min(axis=1) <= box[1])).all(axis=1)
    return reaching


def _place(point: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{coordinate:.4g}" for coordinate in point) + ") m"
