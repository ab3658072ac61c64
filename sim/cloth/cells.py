"""Cells of a sheet, which its stiffness within its plane is a law of: triangles of a mesh, rectangles between threads.

In every cell the position x has derivatives d_u = sum_a c_a x_a along the warp and d_v along the weft, unit vectors at
rest. With the strains e_u = |d_u| - 1, e_v = |d_v| - 1 and the shear e_s = (|d_u + d_v| - |d_u - d_v|) / 2^(1/2), twice
the sine of half the angle that warp and weft lack to a right one, the sheet has per area

    W = C (e_u² + e_v² + 2 nu e_u e_v) / 2 + G e_s² / 2,   C = E / (1 - nu²).

A strip that is free across has the stiffness E along warp and weft then, and contracts by nu times its strain, at any
strain; at 45 degrees its stiffness is 4 / (1/G + 2 (1 - nu)/E). Rubber, G = E / (2 (1 + nu)), is alike in all
directions at small strains. Threads of rectangles carry e_u and e_v (`springs`), and their cells nothing but the shear.

Triangles feel the mean of the e_u and e_v of their nodes, which have the mean of their triangles, by area, but for
`OWN_SHARE` (averaged nodal strains: Bonet, Marriott & Hassan 2001). With their own, two lengths of each triangle hardly
change, four a node, which has but three coordinates: then they lock where they fold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.sheet import Grid, RestSheet, triangle_areas

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
