"""Springs and cells of a sheet, how its stiffness becomes theirs, and how long explicit steps may be.

The law of the sheet is that of docs/theory/cloth.md: threads of rectangles carry its strains e_u and e_v, cells between
them its shear e_s, triangles of meshes all three.

A spring holds a weighted sum of its nodes, d = sum_a c_a x_a with sum_a c_a = 0, at a length: two nodes with
c = (1, -1) along threads, three with (1, -2, 1) over a node, four about the edge of two triangles. Its forces
-k (|d| - rest) c_a d/|d| add up to nothing and have no torque. A spring between the outer nodes instead would have no
stiffness against the first bit of bending.

Stiffness of springs, so that a sheet does not depend on how finely it is divided; w is the width that one stands for,
half on the border:

- stretch C [N/m]: k = C w / L along threads, with C of a sheet that cannot contract across
- bending B [N m]: k = B w / L³ over a node; k = B / A about an edge, with the cotangents of Bergou et al. 2006,
  "A quadratic bending model for inextensible surfaces", sec. 3, as c: exact for cylinders on lattices of squares
  (along the threads) and equal triangles
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.sheet import Grid, RestSheet, edges_of, triangle_areas

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of as many nodes each; rectangles of one colour share no node.

    Attributes:
        nodes: (m, arity) int32; three of triangles, four of rectangles.
        along, across: c_a of d_u and d_v [1/m], (m, arity).
        area: [m²], (m,).
        colour: (m,); 0 of triangles, which are solved together.
        swapped: whether warp and weft of a cell are weft and warp of the node, (m, arity); of triangles whose node has
            them from its first one: on curved sheets they may change places.
    """

    nodes: Indices
    along: Floats
    across: Floats
    area: Floats
    colour: Indices
    swapped: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def arity(self) -> int:
        """Nodes of each cell."""
        return int(self.nodes.shape[1])

    @property
    def family(self) -> tuple[int]:
        """Cells are solved in the order of this, those that share it together."""
        return (self.arity,)

    def law(self, cloth: ClothParameters) -> Floats:
        """Of each cell in a cloth: area times C and G [J], nu [-], damping over stiffness [s], (m, 4)."""
        sheet = cloth.plane_stiffness if self.arity == TRIANGLE else 0.0
        count = len(self)
        return np.stack(
            [
                self.area * sheet,
                self.area * cloth.shear_stiffness,
                np.full(count, cloth.poisson_ratio),
                np.full(count, cloth.damping),
            ],
            axis=1,
        )


TRIANGLE, RECTANGLE = 3, 4  # nodes of cells

OWN_SHARE = 0.05
"""Of the stiffness of triangles, that each has by itself: at none, single ones are strained by 11 % where cotton folds
on a mesh of 15 mm, at this by 4 %, and it does not lock yet."""


def cells_of(sheet: RestSheet) -> Cells:
    """All cells of a sheet."""
    return _between_threads(sheet.grid) if sheet.grid is not None else _triangles(sheet)


def _between_threads(grid: Grid) -> Cells:
    """Cells of a rectangle; d_u and d_v are means of two opposite threads."""
    number = np.arange(grid.columns * grid.rows, dtype=np.int32).reshape(grid.rows, grid.columns)
    nodes = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=-1).reshape(-1, 4)
    count = len(nodes)
    j, i = np.divmod(np.arange(count), grid.columns - 1)
    return Cells(
        nodes,
        np.tile(np.array([-0.5, 0.5, -0.5, 0.5]) / grid.step_x, (count, 1)),
        np.tile(np.array([-0.5, -0.5, 0.5, 0.5]) / grid.step_y, (count, 1)),
        np.full(count, grid.step_x * grid.step_y),
        (2 * (j % 2) + i % 2).astype(np.int32),
        np.zeros((count, RECTANGLE), dtype=bool),
    )


def _triangles(sheet: RestSheet) -> Cells:
    """Those of a mesh, with warp and weft as `sheet.warp` has them."""
    corners = sheet.vertices[sheet.triangles]
    sides = corners[:, 1:] - corners[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    axes = np.stack([sheet.warp, np.cross(normal, sheet.warp)], axis=1)
    # x = x_0 + sides^T s: with the sides in coordinates of warp and weft, the columns of their inverse are the c_a.
    inverse = np.linalg.inv(np.einsum("ksi,kai->ksa", sides, axes))
    along, across = (np.concatenate([-c.sum(axis=1, keepdims=True), c], axis=1) for c in np.moveaxis(inverse, 1, 0))
    nodes = sheet.triangles.astype(np.int32)
    return Cells(
        nodes,
        along,
        across,
        triangle_areas(sheet.vertices, sheet.triangles),
        np.zeros(len(nodes), dtype=np.int32),
        _swapped(sheet, normal),
    )


def _swapped(sheet: RestSheet, normal: Floats) -> NDArray[np.bool_]:
    """`Cells.swapped` of triangles with these unit normals, (k, 3)."""
    first = np.zeros(len(sheet.vertices), dtype=np.int64)
    first[sheet.triangles[::-1]] = np.arange(len(sheet.triangles))[::-1, None]
    first = first[sheet.triangles]
    along, across = (
        np.abs(np.einsum("ki,kai->ka", sheet.warp, axis[first])) for axis in (sheet.warp, np.cross(normal, sheet.warp))
    )
    is_swapped: NDArray[np.bool_] = along < across
    return is_swapped


Group = tuple[int, ...]

ALONG_X, ALONG_Y, BEND = range(3)  # of a spring: a thread of a rectangle along x or y, or a bend

SEGMENT_LENGTH = 1023
"""Springs of a thread that are solved at once, at most: with as many nodes as a block of a GPU has threads."""


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs of as many nodes each; those of one colour share no node.

    Attributes:
        nodes: (m, arity) int32.
        coefficients: c_a, (m, arity).
        rest: length without loads [m], (m,).
        share: stiffness over that of the sheet, (m,): [-] of threads, [1/m²] of bends.
        kind: ALONG_X, ALONG_Y or BEND, (m,).
        colour: (m,).
        segment: piece of a thread that the spring belongs to, -1 where springs are solved one by
            one, (m,). Springs of a piece follow one another, each from the last node of the one before, and have one
            colour.
    """

    nodes: Indices
    coefficients: Floats
    rest: Floats
    share: Floats
    kind: Indices
    colour: Indices
    segment: Indices

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def in_segments(self) -> bool:
        """Whether these are threads."""
        return len(self) > 0 and bool(self.segment[0] >= 0)

    @property
    def arity(self) -> int:
        """Nodes of each spring."""
        return int(self.nodes.shape[1])

    @property
    def family(self) -> tuple[int, bool]:
        """Springs are solved in the order of this, those that share it together."""
        return -self.arity, self.in_segments

    def stiffness(self, cloth: ClothParameters) -> Floats:
        """k of each spring in a cloth [N/m], (m,)."""
        sheet = (cloth.plane_stiffness, cloth.plane_stiffness, cloth.bend_stiffness)
        return self.share * np.array(sheet)[self.kind]

    def damping(self, cloth: ClothParameters) -> Floats:
        """Damping of each spring over its stiffness [s], (m,)."""
        return np.array([cloth.damping, cloth.damping, cloth.bend_damping])[self.kind]


def springs_of(sheet: RestSheet) -> list[Springs]:
    """All springs of a sheet, in the order in which they are solved."""
    if sheet.grid is not None:
        return [_along_lines(sheet.grid, 1.0, -2.0, 1.0), _along_lines(sheet.grid, 1.0, -1.0)]
    return [_mesh_bends(sheet)]


# --- rectangles ----------------------------------------------------------------------------------------------------


def _along_lines(grid: Grid, *coefficients: float) -> Springs:
    """Springs of neighbouring nodes along x, then along y, line by line: two of threads, three of bends.

    Colours of threads alternate along each from piece to piece, those of bends come in turn.
    """
    groups, pieces, arity, is_thread = [], 0, len(coefficients), len(coefficients) == 2
    number = np.arange(grid.columns * grid.rows, dtype=np.int32).reshape(grid.rows, grid.columns)
    for axis, line, step, spacing in ((0, number, grid.step_x, grid.step_y), (1, number.T, grid.step_y, grid.step_x)):
        length = max(line.shape[1] - arity + 1, 0)
        width = np.full((len(line), 1), spacing)
        width[[0, -1]] *= 0.5
        of_line, place = np.divmod(np.arange(len(line) * length, dtype=np.int32), max(length, 1))
        of_each, piece = -(-length // SEGMENT_LENGTH), place // SEGMENT_LENGTH
        nodes = np.stack([line[:, k : k + length] for k in range(arity)], axis=-1).reshape(-1, arity)
        groups.append(
            Springs(
                nodes,
                np.tile(coefficients, (len(nodes), 1)),
                np.full(len(nodes), step if is_thread else 0.0),
                np.repeat(width / (step if is_thread else step**3), length),
                _all((ALONG_X, ALONG_Y)[axis] if is_thread else BEND, len(nodes)),
                2 * axis + piece % 2 if is_thread else 3 * axis + place % 3,
                pieces + of_line * of_each + piece if is_thread else _all(-1, len(nodes)),
            )
        )
        pieces += len(line) * of_each
    return _joined(groups)


def _all(value: int, count: int) -> Indices:
    return np.full(count, value, dtype=np.int32)


# --- meshes --------------------------------------------------------------------------------------------------------


def _mesh_bends(sheet: RestSheet) -> Springs:
    """One about each edge of two triangles: its two ends, then the corners opposite of it."""
    edges, triangle_area = edges_of(sheet.triangles), triangle_areas(sheet.vertices, sheet.triangles)
    order = np.argsort(edges.of_side, kind="stable")
    inner = np.flatnonzero(np.bincount(edges.of_side) == 2)
    first = np.searchsorted(edges.of_side[order], inner)
    sides = order[np.stack([first, first + 1], axis=1)]  # side s of triangle t has the number 3 t + s
    opposite = sheet.triangles[sides // 3, (sides + 2) % 3]
    nodes = np.concatenate([edges.nodes[inner], opposite], axis=1).astype(np.int32)

    a, b, *others = np.moveaxis(sheet.vertices[nodes], 1, 0)
    at_a = [_cotangent(b - a, c - a) for c in others]
    at_b = [_cotangent(a - b, c - b) for c in others]
    coefficients = np.stack([at_b[0] + at_b[1], at_a[0] + at_a[1], -(at_a[0] + at_b[0]), -(at_a[1] + at_b[1])], axis=1)
    lever = np.einsum("ma,mai->mi", coefficients, sheet.vertices[nodes])
    rest = np.linalg.norm(lever, axis=1)
    flat = rest < FLAT * np.abs(coefficients).max(axis=1) * np.linalg.norm(b - a, axis=1)
    return Springs(
        nodes,
        coefficients,
        np.where(flat, 0.0, rest),
        1.0 / triangle_area[sides // 3].sum(axis=1),
        _all(BEND, len(nodes)),
        greedy_colours(nodes, len(sheet.vertices)),
        _all(-1, len(nodes)),
    )


FLAT = 1.0e-5
"""Two triangles that rise from their plane by less, in lengths of their common edge, are flat: files hold float32."""


def joined(
    parts: Sequence[Sequence[Any]], node_offsets: Sequence[int], *, groups: Sequence[Group] | None = None
) -> list[tuple[Any, Indices]]:
    """Springs or cells of several cloths, those that are solved alike together and sorted by colour; the cloth of each.

    Args:
        parts: the springs, or the cells, of each cloth.
        node_offsets: number of its first node.
        groups: which of each cloth; only springs of cloths of one are joined, those of all if omitted.
    """
    families: dict[tuple[Any, ...], list[tuple[int, Any]]] = {}
    for number, cloth in enumerate(parts):
        for elements in cloth:
            if len(elements):
                key = (groups[number] if groups else (), *elements.family)
                families.setdefault(key, []).append((number, elements))
    found = []
    for key in sorted(families):
        moved, pieces = [], 0
        for number, elements in families[key]:
            nodes = (elements.nodes + node_offsets[number]).astype(np.int32)
            changed = {"nodes": nodes}
            if isinstance(elements, Springs):
                segment = np.where(elements.segment < 0, -1, elements.segment + pieces).astype(np.int32)
                pieces = max(pieces, int(segment.max()) + 1)
                changed["segment"] = segment
            moved.append(replace(elements, **changed))
        cloth_of = np.concatenate([_all(number, len(elements)) for number, elements in families[key]])
        whole = _joined(moved)
        order = np.argsort(whole.colour, kind="stable")
        found.append((_mapped(lambda array, rows=order: array[rows], whole), cloth_of[order]))
    return found


def _joined(parts: list[Any]) -> Any:
    return _mapped(lambda *arrays: np.concatenate(arrays), *parts)


def _mapped(function: Callable[..., Any], *parts: Any) -> Any:
    """Springs or cells whose arrays are a function of those of others."""
    return type(parts[0])(*(function(*(getattr(part, field.name) for part in parts)) for field in fields(parts[0])))


def _cotangent(first: Floats, second: Floats) -> Floats:
    cotangent: Floats = np.einsum("mi,mi->m", first, second) / np.linalg.norm(np.cross(first, second), axis=1)
    return cotangent


_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio (Knuth 1973, vol. 3, 6.4): consecutive numbers get priorities far from each other."""


def greedy_colours(nodes: NDArray[np.integer], node_count: int) -> NDArray[np.int32]:
    """A colour for each spring, (m,), such that springs of one colour share no node.

    Colour by colour, a maximal set of independent springs is taken from those left: in rounds, those that come before
    all their neighbours in a fixed order (Luby 1986, with hashed priorities).

    Args:
        nodes: of each spring, (m, arity).
        node_count: number of nodes.
    """
    count = len(nodes)
    priority = np.empty(count, dtype=np.int64)
    priority[np.argsort(np.arange(count, dtype=np.uint64) * _HASH, kind="stable")] = np.arange(count)
    colours = np.full(count, -1, dtype=np.int32)
    left = np.arange(count)
    colour = 0
    while len(left):
        candidates = left
        taken = np.zeros(node_count, dtype=bool)
        while len(candidates):
            first = np.full(node_count, count, dtype=np.int64)
            np.minimum.at(first, nodes[candidates].ravel(), np.repeat(priority[candidates], nodes.shape[1]))
            chosen = candidates[(first[nodes[candidates]] == priority[candidates, None]).all(axis=1)]
            colours[chosen] = colour
            taken[nodes[chosen].ravel()] = True
            candidates = candidates[~taken[nodes[candidates]].any(axis=1)]
        left = left[colours[left] < 0]
        colour += 1
    return colours


STEP_SAFETY = 0.7
"""Share of the linear limit that counts as stable, omega dt < 1.4: springs that turn are not linear, and modes that
swing once in three or four steps (omega dt = 3^(1/2) and 2^(1/2)) resonate (Schlick et al. 1998, "Nonlinear resonance
artifacts in molecular dynamics simulations")."""

ACCURATE_SHARE = 0.34
"""Share of the longest stable step that explicit springs take if no number of substeps is given: the energy of a sheet
that swings undamped for 10 s then stays within 0.3 %, and the error falls with the square of the step."""


def longest_explicit_step(
    families: Iterable[tuple[Springs, Floats, Floats]], cells: Iterable[tuple[Cells, Floats]], inverse_mass: Floats
) -> float:
    """Longest stable step of symplectic Euler [s]; infinite without springs.

    A mode of frequency omega with damping tau omega² is stable up to dt² omega² + 2 dt tau omega² = 4, and row sums
    bound it: omega² <= max_i w_i sum_s k_s |c_i| sum_b |c_b|.

    Args:
        families: springs, their stiffness k [N/m], (m,), and damping over stiffness tau [s], (m,).
        cells: cells and their law, (m, 4).
        inverse_mass: of all nodes [1/kg], (n,); 0 where a node is held.
    """
    found: list[tuple[Indices, Floats, Floats]] = []
    for springs, stiffness, damping in families:
        size = np.abs(springs.coefficients)
        found.append((springs.nodes, size * size.sum(axis=1, keepdims=True) * stiffness[:, None], damping))
    for group, law in cells:
        stretch, shear, poisson, tau = law.T
        u, v = np.abs(group.along), np.abs(group.across)
        row = (stretch * (1.0 + poisson))[:, None] * (
            u * u.sum(axis=1, keepdims=True) + v * v.sum(axis=1, keepdims=True)
        )
        row += shear[:, None] * (u + v) * (u + v).sum(axis=1, keepdims=True)
        found.append((group.nodes, row, tau))
    rows = np.zeros((2, len(inverse_mass)))
    for nodes, row, tau in found:
        for number, values in enumerate((row, row * tau[:, None])):
            rows[number] += np.bincount(nodes.ravel(), weights=values.ravel(), minlength=rows.shape[1])
    squared, damped = (float(rate) for rate in (rows * inverse_mass).max(axis=1))
    if squared == 0.0:
        return math.inf
    return STEP_SAFETY * (math.sqrt(damped**2 + 4.0 * squared) - damped) / squared


def too_few_substeps(substeps: int, frame_dt: float, stable_dt: float) -> str | None:
    """Why so many steps a frame of `frame_dt` [s] are too few for explicit springs, or None."""
    if frame_dt / substeps <= stable_dt:
        return None
    return (
        f"{substeps} substeps a frame are {frame_dt / substeps:.3g} s each, and explicit springs of this stiffness and "
        f"mass are stable up to {stable_dt:.3g} s; give substeps = {math.ceil(frame_dt / stable_dt)} or more, omit it, "
        'or use integrator = "xpbd"'
    )
