"""Elastic energy of cloth in float64, from the law of its springs and cells (docs/theory/cloth.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.cloth.springs import BEND, OWN_SHARE, TRIANGLE, Cells

if TYPE_CHECKING:
    from sim.cloth.device_springs import DeviceSprings
    from sim.cloth.solver import ClothSolver

Floats = NDArray[np.float64]


def elastic_energy(solver: ClothSolver, positions: Floats) -> float:
    """Of all cloths [J], with nodes at positions [m], (n, 3)."""
    of_springs = sum(spring_energies(springs, positions).sum() for springs in solver._springs)
    return float(of_springs + sum(cell_energies(cells.host, positions, cells.law).sum() for cells in solver._cells))


def spring_energies(springs: DeviceSprings, positions: Floats) -> Floats:
    """Of each spring [J], (m,); those of threads feel the strain across: with tensions C (e_u + nu e_v)."""
    host, shift = springs.host, 0.0
    d = np.einsum("ma,mai->mi", host.coefficients, positions[host.nodes])
    stretch = np.linalg.norm(d, axis=1) - host.rest
    if springs.contracts:
        assert (host.kind != BEND).all()
        own = 2 * host.nodes + host.kind[:, None]
        strain = np.bincount(own.ravel(), weights=np.repeat(stretch / host.rest, 2), minlength=own.max() + 2)
        mean = strain / np.maximum(np.bincount(own.ravel(), minlength=len(strain)), 1)
        shift = springs.poisson * host.rest * mean[own ^ 1].mean(axis=1)
    energies: Floats = 0.5 * springs.stiffness * stretch * (stretch + shift)
    return energies


def cell_strains(cells: Cells, positions: Floats) -> Floats:
    """e_u, e_v and e_s of each cell [-], (m, 3), with nodes at positions [m], (n, 3)."""
    u, v = (np.einsum("ma,mai->mi", c, positions[cells.nodes]) for c in (cells.along, cells.across))
    length = [np.linalg.norm(d, axis=1) for d in (u, v, u + v, u - v)]
    return np.stack([length[0] - 1.0, length[1] - 1.0, (length[2] - length[3]) * np.sqrt(0.5)], axis=1)


def cell_energies(cells: Cells, positions: Floats, law: Floats) -> Floats:
    """Of each cell [J], (m,), with the law of `Cells.law`, (m, 4)."""
    strains, (stretch, shear, poisson, _) = cell_strains(cells, positions), law.T
    energies: Floats = 0.5 * shear * strains[:, 2] ** 2
    if cells.arity == TRIANGLE:
        means = _at_corners(cells, strains[:, :2], law)
        for of_area, of_stretch in ((OWN_SHARE, strains[:, None, :2]), (1.0 - OWN_SHARE, means)):
            u, v = of_stretch[..., 0], of_stretch[..., 1]
            energies += of_area * 0.5 * stretch * (u * u + v * v + 2.0 * poisson[:, None] * u * v).mean(axis=1).T
    return energies


def _at_corners(cells: Cells, strains: Floats, law: Floats) -> Floats:
    """Means at the nodes of strains e_u and e_v, (m, 2), for each corner of a cell in its axes, (m, arity, 2)."""
    turned = np.where(cells.swapped[..., None], strains[:, None, ::-1], strains[:, None])
    nodes, weight = cells.nodes.ravel(), np.repeat(law[:, 0], cells.arity)
    u, v = (np.bincount(nodes, weights=weight * turned[..., axis].ravel()) for axis in (0, 1))
    total = np.maximum(np.bincount(nodes, weights=weight), np.finfo(float).tiny)
    means = np.stack([u / total, v / total], axis=1)[cells.nodes]
    return np.where(cells.swapped[..., None], means[..., ::-1], means)
