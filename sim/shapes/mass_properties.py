"""Mass, centre of mass and inertia of a body of even density, and of one with point masses in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.shapes.solid import HasSignedDistance, Points, TriangleMesh

_CELLS_PER_BLOCK = 4


@dataclass(frozen=True, eq=False)
class MassProperties:
    """What the equations of motion need of a rigid body, in the frame of its mesh or solid."""

    mass: float  # [kg]
    centre_of_mass: NDArray[np.float64]  # [m], (3,)
    inertia: NDArray[np.float64]  # inertia tensor about the centre of mass [kg m²], (3, 3), symmetric

    def with_point_mass(self, mass: float, position: ArrayLike) -> MassProperties:
        """The same body with a point mass [kg] fixed at a position [m], (3,): the parallel axis theorem."""
        total = self.mass + mass
        offset = np.asarray(position, dtype=np.float64) - self.centre_of_mass
        reduced = self.mass * mass / total
        inertia = self.inertia + reduced * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        return MassProperties(total, self.centre_of_mass + mass / total * offset, inertia)

    def joined(self, other: MassProperties) -> MassProperties:
        """Both bodies as one."""
        whole = self.with_point_mass(other.mass, other.centre_of_mass)
        return MassProperties(whole.mass, whole.centre_of_mass, whole.inertia + other.inertia)

    def placed(self, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> MassProperties:
        """The same body turned by a matrix, (3, 3), then moved [m], (3,)."""
        return MassProperties(
            self.mass, rotation @ self.centre_of_mass + position, rotation @ self.inertia @ rotation.T
        )


def mass_properties_of_mesh(mesh: TriangleMesh, density: float) -> MassProperties:
    """Mass properties of what a mesh without overlapping parts encloses (Eberly 2002, "Polyhedral mass properties").

    Raises:
        ValueError: the mesh is open or inside out, so that its integrals mean nothing.
    """
    import trimesh

    if not mesh.is_closed or mesh.signed_volume <= 0.0:
        raise ValueError(
            "mass properties need a closed mesh with outward normals; use mass_properties_of_solid for others"
        )
    properties = trimesh.triangles.mass_properties(mesh.corners, density=density)
    return MassProperties(float(properties.mass), np.asarray(properties.center_mass), np.asarray(properties.inertia))


def mass_properties_of_solid(solid: HasSignedDistance, density: float) -> MassProperties:
    """Mass properties by integration over a signed distance: for meshes with holes and overlapping parts.

    Raises:
        ValueError: the solid is thinner than the cells can see.
    """
    moments = integrate_moments(solid)
    if not moments.volume > 0.0:
        raise ValueError("the solid encloses no volume at this resolution; use more cells")
    centre = moments.first / moments.volume
    second = density * (moments.second - moments.volume * np.outer(centre, centre))
    return MassProperties(density * moments.volume, centre, np.trace(second) * np.eye(3) - second)


class VolumeMoments(NamedTuple):
    """Integrals over the inside, about the origin."""

    volume: float  # ∫ dV [m³]
    first: NDArray[np.float64]  # ∫ x dV [m⁴], (3,)
    second: NDArray[np.float64]  # ∫ x xᵀ dV [m⁵], (3, 3)


def integrate_moments(solid: HasSignedDistance, *, cells: int = 64) -> VolumeMoments:
    """Moments of a solid with so many cells along its longest edge; 64 give a sphere's volume within 0.1 %.

    Second order in the size of the cells: one cut by the surface counts with the fraction clip(1/2 - distance/edge, 0,
    1) of its volume. Blocks of 4³ cells whose centre is farther from the surface than their corners count as a whole.
    """
    lower, upper = solid.bounds
    edge = float((upper - lower).max()) / cells
    block_edge = _CELLS_PER_BLOCK * edge
    counts = np.ceil((upper - lower) / block_edge + 0.25).astype(int)  # a cell of margin: half of it on either side
    first_block = 0.5 * (lower + upper) - 0.5 * block_edge * (counts - 1)
    blocks = first_block + block_edge * np.stack(np.indices(counts), axis=-1).reshape(-1, 3)

    distance = solid.signed_distance(blocks)
    near = np.abs(distance) < 0.5 * np.sqrt(3.0) * block_edge + 0.5 * edge
    offsets = (np.indices((_CELLS_PER_BLOCK,) * 3).reshape(3, -1).T - 0.5 * (_CELLS_PER_BLOCK - 1)) * edge
    nodes = (blocks[near][:, None] + offsets).reshape(-1, 3)
    fraction = np.clip(0.5 - solid.signed_distance(nodes) / edge, 0.0, 1.0)
    whole = blocks[~near & (distance < 0.0)]
    of_blocks = _sum_cells(whole, np.ones(len(whole)), block_edge)
    of_nodes = _sum_cells(nodes, fraction, edge)
    return VolumeMoments(*(a + b for a, b in zip(of_blocks, of_nodes, strict=True)))


def _sum_cells(centres: Points, fraction: NDArray[np.float64], edge: float) -> VolumeMoments:
    """Moments of cubes with the given edge, each filled evenly by its fraction."""
    weight = fraction * edge**3
    about_own_centres = np.eye(3) * (weight.sum() * edge**2 / 12.0)
    return VolumeMoments(
        float(weight.sum()), weight @ centres, (centres * weight[:, None]).T @ centres + about_own_centres
    )
