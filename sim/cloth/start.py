"""How cloths start: where the nodes of a sheet are, which of them pins hold, and whether sheets cross."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sim.cloth.parameters import ClothParameters, PinParameters, SphereRegion
from sim.cloth.sheet import RestSheet, build_sheet
from sim.core.domain import DomainParameters
from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath

Floats = NDArray[np.float64]
Indices = NDArray[np.integer]

REGION_MARGIN = 1.0e-6
"""Nodes so far outside of a region still count [m]: sizes written in decimal do not add up exactly."""

TOUCHING = 1.0e-6
"""Elements so near [m] count as meeting: which side of the other one is on is little more than rounding."""

LATTICE_BITS = 30
"""Positions are whole multiples of a quantum, up to 2^30 of them within reach; twice that is all an int32 holds."""

LOST_DISTANCE = 10.0  # cloth stops this far out, in diagonals of the domain: it fell out of sight

COARSEST = 0.25
"""Most that positions may be rounded to, in thicknesses: contacts do not know which layer is above beyond that."""

PAIRS_AT_ONCE = 1_000_000
"""Pairs of an edge and a triangle that are looked at together, up to 400 MB; more only where one edge has more."""


def start_positions(cloth: ClothParameters, sheet: RestSheet) -> Floats:
    """Where the nodes of a cloth start [m], (n, 3)."""
    turned: Floats = Rotation.from_euler("xyz", cloth.rotation_deg, degrees=True).apply(sheet.vertices)
    return turned + np.asarray(cloth.position)


# --- rounding ------------------------------------------------------------------------------------------------------


def reach_of(domain: DomainParameters, positions: Floats) -> float:
    """How far from the origin, along an axis, cloths that start at positions [m], (n, 3), may come [m]."""
    corners = np.concatenate([np.array([domain.min, domain.max]), positions])
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return float(np.abs(corners).max()) + LOST_DISTANCE * diagonal


def quantum_of(reach: float) -> float:
    """Unit of positions within a reach [m]."""
    return float(2.0 ** (np.ceil(np.log2(reach)) - LATTICE_BITS))


def too_coarse_positions(cloth: ClothParameters, position: Floats, reach: float) -> str | None:
    """Why positions within a reach [m] are too coarse for a cloth that starts at some [m], (n, 3), or None.

    They are rounded to the quantum, and to float32 where contacts are found.
    """
    unit = max(quantum_of(reach), float(np.spacing(np.float32(np.abs(position).max()))))
    if unit <= COARSEST * cloth.thickness:
        return None
    return (
        f"its positions are rounded to {unit:.2g} m, and its layers keep {cloth.thickness:g} m; make the domain "
        "smaller, move the scene nearer to the origin, or make the cloth thicker"
    )


# --- pins ----------------------------------------------------------------------------------------------------------


def pinned_nodes(pin: PinParameters, sheet: RestSheet, position: Floats) -> NDArray[np.int64]:
    """Numbers of the nodes that a pin holds, ascending.

    Args:
        pin: the pin.
        sheet: of its cloth.
        position: of the cloth's nodes at the start [m], (n, 3).

    Raises:
        ValueError: there is no such node, or none in the region.
    """
    if pin.index is not None:
        count = len(sheet.node_of_vertex)
        if beyond := [number for number in pin.index if number >= count]:
            kind = "sheet has nodes" if sheet.grid is not None else "mesh has vertices"
            raise ValueError(f"index {beyond[0]} does not exist; the {kind} 0 to {count - 1}")
        nodes = sheet.node_of_vertex[list(pin.index)]
        if (nodes < 0).any():
            unused = pin.index[int(np.flatnonzero(nodes < 0)[0])]
            raise ValueError(f"index {unused} is a vertex that no triangle of the mesh uses; pin another")
        return np.unique(nodes).astype(np.int64)
    if pin.region is not None:
        return _nodes_in_region(pin, position)
    assert sheet.grid is not None
    last = (sheet.grid.columns - 1, sheet.grid.rows - 1)
    j, i = np.divmod(np.arange(len(position)), sheet.grid.columns)
    name = pin.corner or pin.edge or ""
    within = np.ones(len(position), dtype=bool)
    for axis, side in zip(name[::2], name[1::2], strict=True):
        number = 0 if axis == "x" else 1
        within &= (i, j)[number] == (last[number] if side == "+" else 0)
    return np.flatnonzero(within)


def pins_of(cloth: ClothParameters) -> list[NDArray[np.int64]]:
    """The nodes that each pin of a cloth holds, in the cloth's own numbers.

    Raises:
        ShapeError, ValueError: as `build_sheet` and `pinned_nodes`.
    """
    if not cloth.pin:
        return []
    sheet = build_sheet(cloth.shape)
    position = start_positions(cloth, sheet)
    return [pinned_nodes(pin, sheet, position) for pin in cloth.pin]


def path_of_pin(pin: PinParameters) -> KeyframePath:
    """Offset and rotation of a pin that has keyframes, by time."""
    return KeyframePath(
        [keyframe.time_s for keyframe in pin.keyframe],
        np.array([keyframe.offset for keyframe in pin.keyframe], dtype=np.float64),
        np.stack([rotation.from_degrees(keyframe.rotation_deg) for keyframe in pin.keyframe]),
        linear=pin.interpolation == "linear",
    )


def _nodes_in_region(pin: PinParameters, position: Floats) -> NDArray[np.int64]:
    region = pin.region
    assert region is not None
    if isinstance(region, SphereRegion):
        within = np.linalg.norm(position - region.position, axis=1) <= region.radius + REGION_MARGIN
    else:
        low, high = np.asarray(region.min) - REGION_MARGIN, np.asarray(region.max) + REGION_MARGIN
        within = ((position >= low) & (position <= high)).all(axis=1)
    if not within.any():
        low, high = position.min(axis=0), position.max(axis=0)
        span = " ".join(f"{axis} {a:.4g}..{b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise ValueError(f"no node starts in its region; the cloth spans {span} m")
    return np.flatnonzero(within)


# --- crossings -----------------------------------------------------------------------------------------------------


def first_crossing(position: Floats, edges: Indices, triangles: Indices) -> Floats | None:
    """Where an edge passes through or touches a triangle with which it shares no node [m], (3,); None if none does.

    Two triangles that cross have such an edge. One that comes within `TOUCHING` counts: in scenes made of round numbers
    sheets cross at their nodes, and sheets that overlap in one plane have no side of each other to be kept on.
    Triangles of like size are searched together, so that large ones do not make the search around small ones wide.

    Args:
        position: of nodes [m], (n, 3).
        edges: (e, 2) node numbers.
        triangles: (k, 3) node numbers.
    """
    if not len(edges) or not len(triangles):
        return None
    ends, corners = position[edges], position[triangles]
    middle, centre = ends.mean(axis=1), corners.mean(axis=1)
    reach = np.linalg.norm(ends - middle[:, None], axis=2).max(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    power_of_two = np.frexp(radius)[1]
    for power in np.unique(power_of_two):
        group = np.flatnonzero(power_of_two == power)
        for edge, member in _near_pairs(cKDTree(centre[group]), middle, reach + radius[group].max()):
            triangle = group[member]
            apart = (edges[edge][:, :, None] != triangles[triangle][:, None, :]).all(axis=(1, 2))
            point = _first_piercing(ends[edge[apart]], corners[triangle[apart]])
            if point is not None:
                return point
    return None


def _near_pairs(
    tree: cKDTree, centres: Floats, reaches: Floats
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Numbers of centres (n, 3) and of the tree's points within their reaches (n,) [m], some pairs at a time, (m,)."""
    counts = tree.query_ball_point(centres, reaches, return_length=True)
    meeting = np.flatnonzero(counts)
    batch = np.cumsum(counts[meeting]) // PAIRS_AT_ONCE
    for numbers in np.split(meeting, np.flatnonzero(np.diff(batch)) + 1):
        if len(numbers):
            near = tree.query_ball_point(centres[numbers], reaches[numbers])
            yield np.repeat(numbers, counts[numbers]), np.concatenate(near).astype(np.int64)


def _first_piercing(ends: Floats, corners: Floats) -> Floats | None:
    """The first point where a segment passes through or touches the triangle of the same row."""
    low = np.maximum(ends.min(axis=1), corners.min(axis=1))
    high = np.minimum(ends.max(axis=1), corners.max(axis=1))
    near = np.flatnonzero((low <= high + TOUCHING).all(axis=1))
    for meeting in (_piercings, _touches_at_end, _touches_at_side):
        point = meeting(ends[near], corners[near])
        if len(point):
            first: Floats = point[0]
            return first
    return None


def _piercings(ends: Floats, corners: Floats) -> Floats:
    """Where segments (m, 2, 3) pass through the triangles (m, 3, 3) of the same rows [m], (k, 3), by signed volumes."""
    (p, q), (a, b, c) = np.moveaxis(ends, 1, 0), np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    above, below = _dot(p - a, normal), _dot(q - a, normal)
    sides = [_dot(q - p, np.cross(u - p, v - p)) for u, v in ((a, b), (b, c), (c, a))]
    through = (above * below <= 0.0) & (above != below)
    through &= np.all([side >= 0.0 for side in sides], axis=0) | np.all([side <= 0.0 for side in sides], axis=0)
    share = above[through] / (above - below)[through]
    point: Floats = p[through] + share[:, None] * (q - p)[through]
    return point


def _touches_at_end(ends: Floats, corners: Floats) -> Floats:
    """Ends of segments within `TOUCHING` of the triangles of the same rows [m], (k, 3)."""
    from trimesh.triangles import closest_point

    return np.concatenate(
        [p[np.linalg.norm(p - closest_point(corners, p), axis=1) <= TOUCHING] for p in np.moveaxis(ends, 1, 0)]
    )


def _touches_at_side(ends: Floats, corners: Floats) -> Floats:
    """Points of segments within `TOUCHING` of a side of the triangles of the same rows [m], (k, 3)."""
    p, q = np.moveaxis(ends, 1, 0)
    touching = []
    for number in range(3):
        a, b = corners[:, number], corners[:, (number + 1) % 3]
        point, other = _nearest_points(p, q - p, a, b - a)
        touching.append(point[np.linalg.norm(point - other, axis=1) <= TOUCHING])
    return np.concatenate(touching)


def _nearest_points(p: Floats, along: Floats, a: Floats, along_other: Floats) -> tuple[Floats, Floats]:
    """Where segments p + s d, a + t e are nearest each other [m], (m, 3) each (Ericson 2005, section 5.1.9)."""
    between = p - a
    dd, ee, de = _dot(along, along), _dot(along_other, along_other), _dot(along, along_other)
    db, eb = _dot(along, between), _dot(along_other, between)
    area_squared = dd * ee - de * de
    s = np.clip(_quotient(de * eb - ee * db, area_squared), 0.0, 1.0)
    t = np.clip(_quotient(de * s + eb, ee), 0.0, 1.0)
    s = np.clip(_quotient(de * t - db, dd), 0.0, 1.0)
    return p + s[:, None] * along, a + t[:, None] * along_other


def _quotient(numerator: Floats, denominator: Floats) -> Floats:
    """Their quotient; 0 where the denominator is."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator != 0.0)


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("ij,ij->i", a, b)
    return product
