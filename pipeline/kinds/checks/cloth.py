"""Checks of cloths: sheets, pins, and the places where they start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.checks.cloth_bodies import ClothAtStart, check_bodies_for_cloth
from pipeline.kinds.checks.cloth_fluid import check_buoyancy, fluid_over
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.meshes import mesh_exists
from pipeline.kinds.checks.pins import check_pin_load, check_pin_speed, check_pin_times
from pipeline.model.amounts import count, gigabytes
from pipeline.model.boxes import Box, domain_box, span, touch
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import RUNAWAY_SPEED, RectangleSheet, shared_conflicts
from sim.shapes.parameters import MeshShape

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.cloth.parameters import ClothParameters
    from sim.cloth.sheet import RestSheet
    from sim.core.domain import DomainParameters
    from sim.shapes import Solid

BYTES_PER_NODE = 6000
"""What the solver takes: 2.7 kB for six springs, two triangles, what building them takes for a moment, and snapshots
(measured with 62,500 nodes in a flat sheet), and room for some forty contacts a node in a bundle."""
VAST = 20.0
"""A mesh that is so many times as large as the domain is in other units, most likely."""
ROUND_OFF = 1.0e-6
"""Cloth that is laid onto a body, in decimal numbers, may be so deep in it [m]."""

MANY_SUBSTEPS = 3000
"""Of explicit springs in a frame: 150 times as many as XPBD takes."""


@dataclass(frozen=True)
class _Room:
    """Memory for one more cloth.

    Attributes:
        budget: of all cloths.
        nodes_before: of the cloths that have their place.
    """

    budget: MemoryBudget
    nodes_before: int

    def refusal(self, nodes: int) -> str | None:
        """Reason why a cloth of so many nodes does not fit; None if it does."""
        need = (self.nodes_before + nodes) * BYTES_PER_NODE
        if need <= self.budget.bytes:
            return None
        together = f" and {count(self.nodes_before)} of the cloths before it" if self.nodes_before else ""
        possible = max(0, self.budget.bytes // BYTES_PER_NODE - self.nodes_before)
        return (
            f"{count(nodes)} nodes{together} need {gigabytes(need)}, {self.budget.owner} has "
            f"{gigabytes(self.budget.bytes)}; at most {count(possible)} fit"
        )


@dataclass(frozen=True, eq=False)
class _Start:
    """A cloth where it starts.

    Attributes:
        path: of its table.
        cloth: its parameters.
        sheet: at rest.
        position: of its nodes [m], (n, 3).
        edges: (e, 2) node numbers.
        pinned: nodes of each pin, by its number.
    """

    path: KeyPath
    cloth: ClothParameters
    sheet: RestSheet
    position: NDArray[np.float64]
    edges: NDArray[np.int32]
    pinned: Mapping[int, NDArray[np.int64]]

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Nodes that a pin holds at the start, (n,) bool."""
        held = np.zeros(len(self.position), dtype=bool)
        for nodes in self.pinned.values():
            held[nodes] = True
        return held

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Nodes that a pin holds for ever, (n,) bool."""
        kept = np.zeros(len(self.position), dtype=bool)
        for number, nodes in self.pinned.items():
            kept[nodes] |= self.cloth.pin[number].release_s is None
        return kept

    @cached_property
    def longest_edge(self) -> float:
        """Longest distance of neighbouring nodes [m]."""
        ends = self.position[self.edges]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max())

    @cached_property
    def shortest_edge(self) -> float:
        """Shortest distance of neighbouring nodes at rest [m]."""
        rest = self.sheet.vertices[self.edges]
        return float(np.linalg.norm(rest[:, 1] - rest[:, 0], axis=1).min())

    @property
    def mass(self) -> float:
        """Of the cloth [kg]."""
        return float(self.sheet.node_area.sum()) * self.cloth.mass_per_area

    @property
    def box(self) -> Box:
        """Its bounds."""
        return np.array([self.position.min(axis=0), self.position.max(axis=0)])


def check_cloths(job: Job, solids: Mapping[KeyPath, Solid], budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with the cloths.

    Args:
        job: the job.
        solids: its solid shapes as far as they can be built, by path.
        budget: memory that the simulation may take.
        findings: where errors and warnings go.

    Returns:
        Number of nodes of all cloths, as far as they can be built.
    """
    for number, key, message in shared_conflicts(job.cloth):
        findings.error(("cloth", number, key), message)
    check_pin_times(job, findings)
    for number, cloth in enumerate(job.cloth):
        _check_speeds(("cloth", number), cloth, findings)
    starts: list[_Start] = []
    for index in range(len(job.cloth)):
        before = sum(len(start.position) for start in starts)
        if (start := _start(job, index, _Room(budget, before), findings)) is not None:
            starts.append(start)
    for number, start in enumerate(starts):
        _check_place(start, job.domain, findings)
        _check_size(start, job.domain, findings)
        _check_spacing(start, findings)
        _check_pin_speeds(start, job.fps, findings)
        check_pin_load(
            start.path, start.cloth, nodes=len(start.position), pinned=int(start.kept.sum()), edge=start.shortest_edge,
            fluid_share=fluid_over(job, solids, start.box) / start.mass,
            gravity=float(np.linalg.norm(job.gravity)), fps=job.fps, findings=findings,
        )  # fmt: skip
        check_buoyancy(job, start.path, start.cloth, findings)
        _check_substeps(start, job.fps, findings)
        for path, solid in solids.items():
            if path[0] == "rigid":
                _check_inside(start, job.rigid[int(path[1])].name, solid, findings)
        _check_crossings(start, starts[:number], findings)
    at_start = {
        int(start.path[1]): ClothAtStart(
            start.longest_edge, {number: start.position[nodes] for number, nodes in start.pinned.items()}
        )
        for start in starts
    }
    check_bodies_for_cloth(job, solids, at_start, findings)
    return sum(len(start.position) for start in starts)


def _start(job: Job, index: int, room: _Room, findings: Findings) -> _Start | None:
    """The cloth as the simulation will start it; None if it cannot be built."""
    from sim.cloth.sheet import build_sheet
    from sim.cloth.springs import edges_of
    from sim.cloth.start import start_positions
    from sim.shapes import ShapeError

    path: KeyPath = ("cloth", index)
    cloth = job.cloth[index]
    if not mesh_exists(cloth.shape, path, findings):
        return None
    if isinstance(cloth.shape, RectangleSheet):
        key = "counts" if cloth.shape.counts is not None else "resolution"
        if refusal := room.refusal(math.prod(cloth.shape.node_counts)):
            findings.error((*path, "shape", key), f"{refusal}: divide it less finely")
            return None
    try:
        sheet = build_sheet(cloth.shape)
    except ShapeError as error:
        findings.error((*path, "shape"), str(error))
        return None
    # How many nodes a mesh has is known only now.
    if isinstance(cloth.shape, MeshShape) and (refusal := room.refusal(len(sheet.vertices))):
        findings.error((*path, "shape", "file"), f"{refusal}: take a coarser mesh")
        return None
    for warning in sheet.warnings:
        findings.warn((*path, "shape"), warning)
    position = start_positions(cloth, sheet)
    pinned = _pinned(path, cloth, sheet, position, findings)
    return _Start(path, cloth, sheet, position, edges_of(sheet.triangles).nodes, pinned)


def _pinned(
    path: KeyPath, cloth: ClothParameters, sheet: RestSheet, position: NDArray[np.float64], findings: Findings
) -> dict[int, NDArray[np.int64]]:
    """The nodes of each pin, by its number.

    Notes pins that hold none, which are left out, and moving ones that share a node.
    """
    from sim.cloth.start import pinned_nodes

    holders, pinned = np.full(len(position), -1), {}
    for number, pin in enumerate(cloth.pin):
        place = (*path, "pin", number)
        try:
            nodes = pinned_nodes(pin, sheet, position)
        except ValueError as error:
            findings.error(place, str(error))
            continue
        others = [int(other) for other in np.unique(holders[nodes]) if other >= 0]
        moving = [other for other in others if pin.keyframe or cloth.pin[other].keyframe]
        if moving:
            findings.error(place, f"shares a node with pin[{moving[0]}], and one of them moves; pin each node once")
        holders[nodes] = number
        pinned[number] = nodes
    return pinned


def _check_place(start: _Start, domain: DomainParameters, findings: Findings) -> None:
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


def _check_size(start: _Start, domain: DomainParameters, findings: Findings) -> None:
    """A mesh in millimetres is a thousand times too large; nothing else would tell, if faces are open."""
    largest, room = float(np.ptp(start.box, axis=0).max()), float(np.ptp(domain_box(domain), axis=0).max())
    if isinstance(start.cloth.shape, MeshShape) and largest > VAST * room:
        findings.warn(
            (*start.path, "shape", "file"),
            f"is {largest:.4g} m across, the domain {room:.4g} m; files have no unit and are read in metres: "
            "give shape.size",
        )


def _check_spacing(start: _Start, findings: Findings) -> None:
    """Layers keep the thickness where the sheet is folded; it cannot fold more sharply than its nodes allow."""
    shortest = start.shortest_edge
    if start.cloth.self_collision and start.cloth.thickness > shortest:
        findings.warn(
            (*start.path, "thickness"),
            f"{start.cloth.thickness:g} m is more than the {shortest:.3g} m between neighbouring nodes: every node is "
            "in contact with many others, which takes long; make it thinner, or the sheet coarser",
        )


def _check_pin_speeds(start: _Start, fps: int, findings: Findings) -> None:
    """Nodes follow a pin by their springs, from substep to substep."""
    for number, nodes in start.pinned.items():
        position = start.position[nodes]
        check_pin_speed(
            (*start.path, "pin", number),
            start.cloth,
            reach=float(np.linalg.norm(position - position.mean(axis=0), axis=1).max()),
            longest_edge=start.longest_edge,
            fps=fps,
            findings=findings,
        )


def _check_substeps(start: _Start, fps: int, findings: Findings) -> None:
    """Explicit springs are unstable beyond their step, and without a number of substeps dictate theirs."""
    from sim.cloth.springs import springs_of
    from sim.cloth.stable_step import ACCURATE_SHARE, longest_explicit_step, too_few_substeps
    from sim.core.world import MAX_SUBSTEPS_PER_FRAME

    cloth = start.cloth
    if cloth.integrator != "explicit":
        return
    families = [(springs, springs.stiffness(cloth), springs.damping(cloth)) for springs in springs_of(start.sheet)]
    # Nodes that are let go later need shorter steps from then on.
    inverse_mass = np.where(start.kept, 0.0, 1.0 / (start.sheet.node_area * cloth.mass_per_area))
    longest = longest_explicit_step(families, inverse_mass)
    if cloth.substeps is not None:
        if reason := too_few_substeps(cloth.substeps, 1.0 / fps, longest):
            findings.error((*start.path, "substeps"), reason)
        return
    substeps = math.ceil(1.0 / (fps * ACCURATE_SHARE * longest))
    takes = f'"explicit" takes {count(substeps)} substeps a frame of springs of this stiffness and mass'
    helps = 'give a softer stretch_stiffness or a coarser sheet, or use "xpbd"'
    if substeps > MAX_SUBSTEPS_PER_FRAME:
        most = count(MAX_SUBSTEPS_PER_FRAME)
        findings.error((*start.path, "integrator"), f"{takes}, more than the {most} at which a run ends: {helps}")
    elif substeps > MANY_SUBSTEPS:
        findings.warn((*start.path, "integrator"), f"{takes}, which takes long: {helps}")


def _check_inside(start: _Start, body: str, solid: Solid, findings: Findings) -> None:
    """Refuse cloth in a body: nobody knows which way out is meant. Pinned nodes stay where they are, so they may be."""
    if not touch(start.box, solid.bounds, margin=0.0):
        return
    triangles = start.sheet.triangles
    points = np.concatenate(
        [start.position[~start.held], *(_middles(start, parts) for parts in (start.edges, triangles))]
    )
    near = ((points >= solid.bounds[0]) & (points <= solid.bounds[1])).all(axis=1)
    inside = points[near][solid.signed_distance(points[near]) < -ROUND_OFF] if near.any() else points[:0]
    if len(inside):
        findings.error(start.path, f'starts inside "{body}", as at {_place(inside[0])}; move one of them')


def _middles(start: _Start, parts: NDArray[np.int32]) -> NDArray[np.float64]:
    """Middles of edges or triangles [m] without a pinned node."""
    middles: NDArray[np.float64] = start.position[parts[~start.held[parts].any(axis=1)]].mean(axis=1)
    return middles


def _check_crossings(start: _Start, earlier: Sequence[_Start], findings: Findings) -> None:
    """Refuse cloth that passes through another or touches it, or a mesh itself.

    Contacts keep what crosses crossed, and what touches has no side to be kept on.
    """
    from sim.cloth.start import TOUCHING, first_crossing

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


def _crossing_of(one: _Start, other: _Start) -> NDArray[np.float64] | None:
    """Where an edge of one cloth passes through or touches a triangle of another [m]."""
    from sim.cloth.start import TOUCHING, first_crossing

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
