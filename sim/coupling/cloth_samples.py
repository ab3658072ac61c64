"""Where the samples of cloths are that a particle fluid feels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim.cloth.sheet import RestSheet, build_sheet, triangle_areas
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.kernels import SUPPORT_IN_SPACINGS
from sim.fluid.sheet_samples import SheetSamples, kept_away, sheet_factor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.cloth.solver import ClothSolver

LONGEST_EDGE = 1.5  # longest edge of the part of a triangle that a sample stands for [spacings]


@dataclass(frozen=True, eq=False)
class ClothSamples:
    """Samples of all cloths as fixed points of their triangles."""

    sheets: SheetSamples  # what the fluid takes
    nodes: NDArray[np.int32]  # corners of the triangle of each sample, numbered as the cloth solver does, (m, 3)
    weights: NDArray[np.float64]  # its barycentric coordinates there, at least 0, of sum 1, (m, 3)
    start: NDArray[np.float64]  # where the samples are at the start [m], (m, 3)

    @classmethod
    def of(cls, cloth: ClothSolver, spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS) -> ClothSamples:
        """One sample for each triangle, or several where it is large against the spacing [m].

        Raises:
            ShapeError: a mesh file is missing or unreadable, or its mesh is no sheet.
        """
        cloths = cloth.parameters
        sheets = [build_sheet(each.shape) for each in cloths]
        placed = [_points_of(sheet, spacing) for sheet in sheets]
        rest = [
            np.einsum("mc,mcx->mx", weights, sheet.vertices[sheet.triangles[triangle]])
            for sheet, (triangle, weights) in zip(sheets, placed, strict=True)
        ]
        shares = [1.0 / np.bincount(triangle)[triangle] for triangle, _ in placed]
        areas = [
            share * triangle_areas(sheet.vertices, sheet.triangles)[triangle]
            for share, sheet, (triangle, _) in zip(shares, sheets, placed, strict=True)
        ]
        mass = [area * each.mass_per_area for area, each in zip(areas, cloths, strict=True)]
        margin = kept_away(support_in_spacings) * spacing
        missing = [
            area * (2.0 * margin - each.thickness) + 0.5 * np.pi * margin**2 * _rim_lengths(sheet)[triangle] * share
            for area, share, each, sheet, (triangle, _) in zip(areas, shares, cloths, sheets, placed, strict=True)
        ]
        first_nodes = cloth.state.host.first_node[:-1]
        nodes = np.concatenate(
            [
                sheet.triangles[triangle] + first
                for sheet, (triangle, _), first in zip(sheets, placed, first_nodes, strict=True)
            ]
        ).astype(np.int32)
        weights = np.concatenate([weights for _, weights in placed])
        boundary = BoundarySamples.of_bodies(*rest).scaled(sheet_factor(support_in_spacings))
        return cls(
            SheetSamples(boundary, np.concatenate(mass), np.concatenate(missing)),
            nodes,
            weights,
            np.einsum("mc,mcx->mx", weights, cloth.state.host.position[nodes]),
        )


def _points_of(sheet: RestSheet, spacing: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Centres of equal parts of all triangles, small enough: triangle of each, (m,), and barycentric coordinates."""
    corners = sheet.vertices[sheet.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / (LONGEST_EDGE * spacing)), 1).astype(int)
    triangles, weights = [], []
    for count in np.unique(divisions).tolist():
        own = np.flatnonzero(divisions == count)
        parts = _parts(count)
        triangles.append(np.repeat(own, len(parts)))
        weights.append(np.tile(parts, (len(own), 1)))
    return np.concatenate(triangles), np.concatenate(weights)


def _parts(count: int) -> NDArray[np.float64]:
    """Barycentric coordinates of the centres of count² equal parts of a triangle, (count², 3)."""
    i, j = (each.ravel() for each in np.mgrid[0:count, 0:count])
    upright = np.stack([i, j], axis=1)[i + j < count] + 1.0 / 3.0
    inverted = np.stack([i, j], axis=1)[i + j < count - 1] + 2.0 / 3.0
    two = np.concatenate([upright, inverted]) / count
    return np.concatenate([two, 1.0 - two.sum(axis=1, keepdims=True)], axis=1)


def _rim_lengths(sheet: RestSheet) -> NDArray[np.float64]:
    """Length of the sides of each triangle that are the sheet's rim [m], (k,)."""
    sides = np.stack([sheet.triangles, np.roll(sheet.triangles, -1, axis=1)], axis=2)
    _, inverse, counts = np.unique(
        np.sort(sides.reshape(-1, 2), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    lengths = np.linalg.norm(sheet.vertices[sides[..., 0]] - sheet.vertices[sides[..., 1]], axis=2)
    rim: NDArray[np.float64] = (lengths * (counts[inverse].reshape(lengths.shape) == 1)).sum(axis=1)
    return rim
