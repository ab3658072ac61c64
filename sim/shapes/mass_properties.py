"""Mass, centre of mass and inertia of a body of even density, and of one with point masses in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.shapes.moments import HasSignedDistance, VolumeMoments, integrate_moments
from sim.shapes.solid import TriangleMesh


@dataclass(frozen=True, eq=False)
class MassProperties:
    """What the equations of motion need of a rigid body, in the frame of its mesh or solid.

    Attributes:
        mass: [kg].
        centre_of_mass: [m], (3,).
        inertia: inertia tensor about the centre of mass [kg m²], (3, 3), symmetric.
    """

    mass: float
    centre_of_mass: NDArray[np.float64]
    inertia: NDArray[np.float64]

    def with_point_mass(self, mass: float, position: ArrayLike) -> MassProperties:
        """The same body with a point mass [kg] fixed at a position [m], (3,): the parallel axis theorem."""
        total = self.mass + mass
        offset = np.asarray(position, dtype=np.float64) - self.centre_of_mass
        reduced = self.mass * mass / total
        inertia = self.inertia + reduced * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        return MassProperties(total, self.centre_of_mass + mass / total * offset, inertia)

    def principal_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Principal moments [kg m²], ascending, (3,), and a right-handed rotation with the axes as columns, (3, 3)."""
        moments, axes = np.linalg.eigh(self.inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        return moments, axes


def mass_properties_of_mesh(mesh: TriangleMesh, density: float) -> MassProperties:
    """Mass properties of what a mesh encloses, exact up to round-off (Eberly 2002, "Polyhedral mass properties").

    Args:
        mesh: closed, outward oriented, without overlapping parts.
        density: [kg/m³].

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


def mass_properties_of_solid(solid: HasSignedDistance, density: float, *, cells: int = 64) -> MassProperties:
    """Mass properties by integration over a signed distance: for meshes with holes and overlapping parts.

    Args:
        solid: anything with bounds and a signed distance.
        density: [kg/m³].
        cells: cells along its longest edge; the error falls with the square of their number.

    Raises:
        ValueError: the solid is thinner than the cells can see.
    """
    return _from_moments(integrate_moments(solid, cells=cells), density)


def _from_moments(moments: VolumeMoments, density: float) -> MassProperties:
    if not moments.volume > 0.0:
        raise ValueError("the solid encloses no volume at this resolution; use more cells")
    centre = moments.first / moments.volume
    second = density * (moments.second - moments.volume * np.outer(centre, centre))
    return MassProperties(density * moments.volume, centre, np.trace(second) * np.eye(3) - second)
