"""The shape of a rigid body about its centre of mass: its mass and its distances."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.shapes.assembly import Assembly
from sim.shapes.balls import Balls, exact_balls, surface_balls
from sim.shapes.convex_pieces import convex_pieces
from sim.shapes.distance_grids import sampled_distances
from sim.shapes.level_set import LevelSet
from sim.shapes.mass_properties import MassProperties, mass_properties_of_mesh, mass_properties_of_solid
from sim.shapes.mesh_solid import ConvexSolid, MeshSolid
from sim.shapes.parameters import AnimationShape, BallastParameters, PieceShape, WeightedPlacement
from sim.shapes.placement import PlacedSolid, build_solid
from sim.shapes.solid import Points

if TYPE_CHECKING:
    from sim.shapes.deformation import Deformation

GRID_CELLS = 48  # cells of a distance grid along the longest edge of a mesh; half of them in a convex piece of one
GRID_PADDING = 0.1  # how far a distance grid reaches past its mesh, in longest edges


class BodyGeometry:
    """A body at rest, in its frame: origin at the centre of mass, axes those of its mesh.

    One that deforms is here as in its first sample, but for its box, which holds all that it ever fills.

    Attributes:
        solid: the scaled shape about its own origin, unturned.
        centre_of_mass: in the frame of `solid` [m], (3,).
        deformation: of `solid`, in its frame; None if it is rigid.
    """

    def __init__(self, parameters: WeightedPlacement) -> None:
        """Build the shape; raises ShapeError where that is impossible, or it is too thin to have an inside."""
        placed = build_solid(parameters)
        self.deformation, self._piece = _deformation_of(parameters, placed), None
        if isinstance(parameters.shape, PieceShape):
            self._piece = parameters.shape
        # Without ballast the centre is that of the shape, and bodies without mass have one too.
        self._take(placed, parameters.ballast, parameters.density or 1.0)

    @classmethod
    def of(cls, placed: PlacedSolid) -> BodyGeometry:
        """That of a solid without ballast, wherever it is."""
        geometry = cls.__new__(cls)
        geometry.deformation = geometry._piece = None
        geometry._take(placed, (), 1.0)
        return geometry

    def _take(self, placed: PlacedSolid, ballast: tuple[BallastParameters, ...], density: float) -> None:
        self.solid = PlacedSolid(placed.shape, placed.scale, np.eye(3), np.zeros(3))
        self._materials, self._ballast = _materials(self.solid), ballast
        self.centre_of_mass = self.mass_properties(density).centre_of_mass

    def mass_properties(self, density: float) -> MassProperties:
        """Mass [kg], centre of mass [m] and inertia about it [kg m²], ballast included, in the frame of `solid`.

        Parts of a compound that have a density of their own keep it.
        """
        parts = [
            MassProperties(rho * unit.mass, unit.centre_of_mass, rho * unit.inertia)
            for unit, rho in ((unit, own or density) for unit, own in self._materials)
        ]
        properties = reduce(MassProperties.joined, parts)
        for ballast in self._ballast:
            properties = properties.with_point_mass(ballast.mass, ballast.position)
        return properties

    @cached_property
    def displaced(self) -> tuple[float, NDArray[np.float64]]:
        """Volume [m³], and its centre in the body's frame [m], (3,); where parts of a compound overlap both count."""
        whole = reduce(MassProperties.joined, (unit for unit, _ in self._materials))
        return whole.mass, whole.centre_of_mass - self.centre_of_mass

    @cached_property
    def contact_parts(self) -> tuple[ContactPart, ...]:
        """The solids that stand for the body in contacts: itself, those of an assembly, or convex pieces of a mesh."""
        shape, scale = self.solid.shape, self.solid.scale
        solids: tuple[PlacedSolid, ...] = ()
        if isinstance(shape, Assembly):
            solids = shape.solids
        elif isinstance(shape, MeshSolid) and not isinstance(shape, ConvexSolid) and self.deformation is None:
            solids = convex_pieces(shape)
        if not solids:
            return (ContactPart(self, np.zeros(3), np.eye(3)),)
        found = []
        for solid in solids:
            geometry = BodyGeometry.of(PlacedSolid(solid.shape, scale * solid.scale, np.eye(3), np.zeros(3)))
            position = scale * solid.position + solid.rotation @ geometry.centre_of_mass - self.centre_of_mass
            for part in geometry.contact_parts:
                turned = solid.rotation @ part.rotation
                found.append(ContactPart(part.geometry, position + solid.rotation @ part.position, turned))
        return tuple(found)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of its box [m], (2, 3)."""
        bounds = self.solid.bounds if self.deformation is None else self.deformation.bounds
        return bounds - self.centre_of_mass

    @cached_property
    def radius(self) -> float:
        """Largest distance of its box's corners from the centre of mass [m]."""
        return float(np.linalg.norm(np.abs(self.bounds).max(axis=0)))

    @cached_property
    def shortest_edge(self) -> float:
        """Shortest edge of its box [m]; of an assembly that of its parts."""
        if self.deformation is not None:
            return self.deformation.shortest_edge
        if isinstance(self.solid.shape, Assembly):
            return min(part.geometry.shortest_edge for part in self.contact_parts)
        return float(np.min(self.bounds[1] - self.bounds[0]))

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Exact distance to its surface [m], negative inside, (k,), of points (k, 3) in the body's frame."""
        return self.solid.signed_distance(points + self.centre_of_mass)

    def samples(self, spacing: float) -> Points:
        """Evenly spread points on its surface [m], (m, 3), in the body's frame."""
        return self.solid.surface_samples(spacing).astype(np.float64) - self.centre_of_mass

    @cached_property
    def is_analytic(self) -> bool:
        """Whether its distance is a formula; that of a mesh is read from a grid in contacts."""
        return not isinstance(self.solid.shape, MeshSolid)

    @cached_property
    def reach(self) -> float:
        """How far outside of the body contact distances hold [m]."""
        return np.inf if self.is_analytic else GRID_PADDING * float(np.max(self.bounds[1] - self.bounds[0]))

    @property
    def normal_step(self) -> float:
        """Half width of the differences of distances that contact normals are made of [m]."""
        return 1.0e-7 * self.shortest_edge if self.is_analytic else 0.5 * self.grid.spacing

    @cached_property
    def balls(self) -> Balls:
        """The balls that stand for it in contacts, in the body's frame."""
        found = exact_balls(self.solid)
        balls = surface_balls(self.solid) if found is None else found
        return replace(balls, centres=balls.centres - self.centre_of_mass[:, None])

    def sees_all_contacts_with(self, other: BodyGeometry) -> bool:
        """Whether its balls alone find every contact with another body."""
        return self.balls.exact and bool(np.all(self.balls.radii <= other.reach))

    @cached_property
    def grid(self) -> LevelSet:
        """Distances of a mesh as contacts read them, in the frame of `solid`."""
        if self.deformation is not None:
            return self.deformation.level_set(0.0)
        longest = float(np.max(self.bounds[1] - self.bounds[0]))
        cells = GRID_CELLS // 2 if isinstance(self.solid.shape, ConvexSolid) else GRID_CELLS
        return LevelSet.sample(self.solid, longest / cells, padding=GRID_PADDING * longest)

    @cached_property
    def fine_grid(self) -> LevelSet:
        """Distances of a mesh as cloth and smoke read them, in the frame of `solid`."""
        if self._piece is None:
            return sampled_distances(self.solid)
        from sim.shapes.cutting import wall_and_cell

        return sampled_distances(self.solid, wall_and_cell(self._piece, self.solid)[1])


def _deformation_of(parameters: WeightedPlacement, placed: PlacedSolid) -> Deformation | None:
    """Of a body whose file deforms it."""
    if not isinstance(parameters.shape, AnimationShape):
        return None
    from sim.shapes.animation import AnimatedSolid
    from sim.shapes.deformation import Deformation

    assert isinstance(placed.shape, AnimatedSolid), "an animation is built as one"
    return None if placed.shape.deformed is None else Deformation(placed.shape, parameters.shape, placed.scale)


class ContactPart(NamedTuple):
    """A solid that stands for a body, or a part of it, in contacts."""

    geometry: BodyGeometry
    position: NDArray[np.float64]  # of its centre of mass in the body's frame [m], (3,)
    rotation: NDArray[np.float64]  # its axes to the body's, (3, 3)


def _materials(solid: PlacedSolid) -> list[tuple[MassProperties, float | None]]:
    """Mass properties at 1 kg/m³ of what has one density each, and that density where it is not the body's."""
    shape = solid.shape
    if not isinstance(shape, Assembly) or shape.densities is None:
        return [(_mass_properties(solid), None)]
    found = []
    for part, density in zip(shape.solids, shape.densities, strict=True):
        own = PlacedSolid(part.shape, solid.scale * part.scale, np.eye(3), np.zeros(3))
        for unit, inner in _materials(own):
            found.append((unit.placed(part.rotation, solid.scale * part.position), inner or density))
    return found


def _mass_properties(solid: PlacedSolid) -> MassProperties:
    """Mass properties at 1 kg/m³: from the mesh, scaled to the exact volume; from the inside of meshes with holes."""
    if isinstance(solid.shape, MeshSolid) and not solid.shape.encloses_simply:
        return mass_properties_of_solid(solid, 1.0)
    facetted = mass_properties_of_mesh(solid.rest_mesh(), 1.0)
    larger = solid.volume / facetted.mass  # facets cut off a little of what is round
    return MassProperties(solid.volume, facetted.centre_of_mass, larger ** (5.0 / 3.0) * facetted.inertia)
