"""Cloths where they start, as the simulation will build them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.shapes import mesh_exists
from pipeline.model.amounts import count
from pipeline.model.boxes import Box
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.cloth.parameters import ClothParameters, RectangleSheet
from sim.cloth.sheet import RestSheet, build_sheet, edges_of
from sim.cloth.start import pinned_nodes, start_positions
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import ShapeError

BYTES_PER_NODE = 6000
"""Memory of the solver: 2.7 kB for springs, triangles and snapshots, and some forty contacts a node in a bundle."""


@dataclass(frozen=True, eq=False)
class ClothStart:
    """A cloth where it starts."""

    path: KeyPath  # of its table
    cloth: ClothParameters  # its parameters
    sheet: RestSheet  # at rest
    position: NDArray[np.float64]  # of its nodes [m], (n, 3)
    edges: NDArray[np.int32]  # (e, 2) node numbers
    pinned: Mapping[int, NDArray[np.int64]]  # nodes of each pin, by its number

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Nodes that a pin holds at the start, (n,) bool."""
        return self._held_by(list(self.pinned))

    @cached_property
    def held_for_ever(self) -> NDArray[np.bool_]:
        """Nodes that a pin holds to the end, (n,) bool."""
        return self._held_by([number for number in self.pinned if self.cloth.pin[number].release_s is None])

    @cached_property
    def longest_edge(self) -> float:
        """Longest distance of neighbouring nodes [m]."""
        return float(_lengths(self.position, self.edges).max())

    @cached_property
    def shortest_edge(self) -> float:
        """Shortest distance of neighbouring nodes at rest [m]."""
        return float(_lengths(self.sheet.vertices, self.edges).min())

    @property
    def box(self) -> Box:
        """Its bounds [m]."""
        return np.array([self.position.min(axis=0), self.position.max(axis=0)])

    def _held_by(self, pins: list[int]) -> NDArray[np.bool_]:
        held = np.zeros(len(self.position), dtype=bool)
        for number in pins:
            held[self.pinned[number]] = True
        return held


def start_cloths(job: Job, budget: MemoryBudget, findings: Findings) -> list[ClothStart]:
    """The cloths that can be built; notes what is wrong with the others."""
    starts: list[ClothStart] = []
    for index in range(len(job.cloth)):
        start = _start(job, index, sum(len(start.position) for start in starts), budget, findings)
        starts += [] if start is None else [start]
    return starts


def _start(job: Job, index: int, before: int, budget: MemoryBudget, findings: Findings) -> ClothStart | None:
    """A cloth after so many nodes of others."""
    path: KeyPath = ("cloth", index)
    cloth = job.cloth[index]

    def fits(nodes: int, key: str, remedy: str) -> bool:
        beside = f" and {count(before)} of the cloths before it" if before else ""
        refusal = budget.refusal(nodes, "nodes", BYTES_PER_NODE, before=before, beside=beside)
        if refusal is not None:
            findings.error((*path, "shape", key), f"{refusal}: {remedy}")
        return refusal is None

    if not mesh_exists(cloth.shape, path, findings):
        return None
    if isinstance(cloth.shape, RectangleSheet):
        key = "counts" if cloth.shape.counts is not None else "resolution"
        if not fits(math.prod(cloth.shape.node_counts), key, "divide it less finely"):
            return None
    try:
        sheet = build_sheet(cloth.shape)
    except ShapeError as error:
        findings.error((*path, "shape"), str(error))
        return None
    if isinstance(cloth.shape, MeshShape) and not fits(len(sheet.vertices), "file", "take a coarser mesh"):
        return None
    for warning in sheet.warnings:
        findings.warn((*path, "shape"), warning)
    position = start_positions(cloth, sheet)
    pinned = _pinned(path, cloth, sheet, position, findings)
    return ClothStart(path, cloth, sheet, position, edges_of(sheet.triangles).nodes, pinned)


def _pinned(
    path: KeyPath, cloth: ClothParameters, sheet: RestSheet, position: NDArray[np.float64], findings: Findings
) -> dict[int, NDArray[np.int64]]:
    """The nodes of each pin that holds some, by its number; notes the others, and moving ones that share a node."""
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


def _lengths(position: NDArray[np.float64], edges: NDArray[np.int32]) -> NDArray[np.float64]:
    lengths: NDArray[np.float64] = np.linalg.norm(position[edges[:, 1]] - position[edges[:, 0]], axis=1)
    return lengths
