"""The openings of emitters: the layers of particles in them, the pipes around their nozzles, and what is in the way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.parameters import DiscOpening

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.parameters import EmitterParameters, FluidParameters
    from sim.shapes.solid import Solid

NEAREST_IN_SPACINGS, FARTHEST_IN_SPACINGS = 0.82, 1.35  # of particles and of layers: nearer, they would burst out
PIPE_PLAY_IN_SPACINGS = 0.05  # how much nearer to a pipe than at rest a block may start, whose lattice lies anywhere
LATTICES_TRIED = 41  # lattice constants between 0.9 and 1.1 spacings that are tried for a disc
CELL_MISMATCH = 0.05  # by how much the area of a disc and that of the lattice cells in it may differ

SAME_IN_SPACINGS = 1.0e-3  # nozzles whose particles, and whose sides, differ by less are one


@dataclass(frozen=True)
class Opening:
    """A layer of particles in an opening, from which one layer after the other moves off."""

    centre: NDArray[np.float64]  # of the opening [m], (3,)
    axes: tuple[NDArray[np.float64], NDArray[np.float64]]  # unit vectors along its sides, (3,) each
    half_size: tuple[float, float]  # half the lengths of the sides of what a layer fills, or twice its radius [m]
    is_round: bool  # it is a disc
    points: NDArray[np.float64]  # centres of the particles of a layer as it is in the opening [m], (n, 3)
    velocity: NDArray[np.float64]  # of the inflow [m/s], (3,)
    layer_distance: float  # a layer's volume over the opening's area [m], so that the flow is exactly speed times area
    support_in_spacings: float  # support radius of the fluid's kernel
    start_s: float  # when the first layer leaves [s]
    end_s: float  # no layer leaves from then on [s]

    @classmethod
    def of(
        cls, emitter: EmitterParameters, spacing: float, particle_volume: float, support_in_spacings: float
    ) -> Opening:
        """The opening of an emitter, for particles of this spacing [m] and volume [m³].

        Raises:
            ValueError: it is too narrow for them.
        """
        direction = np.array(emitter.direction, dtype=np.float64)
        direction /= np.linalg.norm(direction)
        layer = _best_layer(emitter, spacing, particle_volume)
        if layer is None:
            raise ValueError(
                f"is too narrow for particles {spacing:g} m apart; enlarge it or use a smaller particle_radius"
            )
        axes, (places, distance) = _axes_across(direction), layer
        # A particle begins half a layer in front of the opening: its volume is then wholly inside the domain.
        centre = np.array(emitter.position, dtype=np.float64)
        points = centre + 0.5 * distance * direction + places @ np.stack(axes)
        return cls(
            centre=centre,
            axes=axes,
            half_size=_half_size(emitter, places, spacing),
            is_round=isinstance(emitter.shape, DiscOpening),
            points=points,
            velocity=emitter.speed * direction,
            layer_distance=distance,
            support_in_spacings=support_in_spacings,
            start_s=emitter.start_s,
            end_s=math.inf if emitter.end_s is None else emitter.end_s,
        )

    @property
    def speed(self) -> float:
        """Of the inflow [m/s]."""
        return float(np.linalg.norm(self.velocity))

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector along the inflow, (3,)."""
        return self.velocity / self.speed

    @property
    def nozzle_layers(self) -> int:
        """Layers in the nozzle, where particles move at the speed of the inflow, whatever pushes.

        They are a support radius deep: a particle that leaves has a whole lattice behind it.
        """
        return math.ceil(self.support_in_spacings)

    @property
    def nozzle_depth(self) -> float:
        """Length of the nozzle along the inflow [m]."""
        return self.nozzle_layers * self.layer_distance

    @property
    def drained_s(self) -> float:
        """When the nozzle becomes empty [s]."""
        return self.end_s + self.nozzle_depth / self.speed

    def nozzle_places(self) -> NDArray[np.float64]:
        """Where particles are in the full nozzle as its last layer leaves the opening [m], (m, 3)."""
        moved = np.arange(self.nozzle_layers) * self.layer_distance
        return (self.points[None] + moved[:, None, None] * self.direction).reshape(-1, 3)

    def distance_to_nozzle(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance of points (m, 3) from the space that the full nozzle fills [m], (m,); 0 in it."""
        from_centre = points - self.centre
        along = from_centre @ self.direction
        across = np.abs(np.stack([from_centre @ axis for axis in self.axes]))
        if self.is_round:
            outside = np.maximum(np.hypot(*across) - self.half_size[0], 0.0)
        else:
            outside = np.hypot(*np.maximum(across - np.array(self.half_size)[:, None], 0.0))
        return np.hypot(outside, np.maximum(np.maximum(-along, along - self.nozzle_depth), 0.0))

    def pipe(self, spacing: float) -> NDArray[np.float64]:
        """Boundary samples of a short pipe around the nozzle [m], (m, 3).

        It keeps surrounding fluid from flowing into the gap that opens behind a layer before the next one fills it.
        The samples are as far outside of the nozzle as those of a wall that touches the fluid. They push, and exert no
        friction (`is_felt_in_nozzles`).
        """
        depths = np.arange(0.0, self.nozzle_depth, spacing)
        outside = (_wall_standoff(self.support_in_spacings) - 0.5) * spacing
        rim = _rim(tuple(half + outside for half in self.half_size), self.is_round, spacing)
        around = self.centre + rim @ np.stack(self.axes)
        return (around[None] + depths[:, None, None] * self.direction).reshape(-1, 3)

    def layers_due(self, time_s: float) -> int:
        """Layers that have left the opening by a time [s]."""
        if time_s < self.start_s:
            return 0
        # The last layer is the last that leaves before the end, which is no time of an emission itself.
        passed = (min(time_s, self.end_s) - self.start_s) * self.speed / self.layer_distance
        return math.ceil(passed * (1.0 - 1.0e-12)) if time_s >= self.end_s else math.floor(passed) + 1

    def layer_at(self, layer: int, time_s: float) -> NDArray[np.float64]:
        """Where the particles of a layer are that has moved on freely since it left [m], (n, 3)."""
        moved_s = time_s - self.start_s - layer * self.layer_distance / self.speed
        return self.points + moved_s * self.velocity

    def total_particles(self) -> float:
        """Particles of all its layers; infinite where it never ends."""
        return math.inf if math.isinf(self.end_s) else float(len(self.points) * self.layers_due(self.end_s))


def openings_of(fluids: Sequence[FluidParameters], particle_volume: float | None = None) -> list[tuple[int, Opening]]:
    """Number of its fluid and opening of each emitter, for particles of a volume [m³]; that of the lattice if omitted.

    Raises:
        ValueError: one is too narrow.
    """
    return [
        (number, Opening.of(emitter, fluid.spacing, particle_volume or fluid.lattice_volume, fluid.support_in_spacings))
        for number, fluid in enumerate(fluids)
        for emitter in fluid.emitter
    ]


def pipe_clearance(support_in_spacings: float) -> float:
    """Least distance of a fluid's particles from the samples of a pipe at the start [spacings]."""
    return _wall_standoff(support_in_spacings) - PIPE_PLAY_IN_SPACINGS


def obstruction(opening: Opening, spacing: float, domain: DomainParameters, solids: Sequence[Solid]) -> str | None:
    """Why fluid cannot enter here, or None: particles of the opening outside the domain, or in a solid."""
    outside = ((opening.points < domain.min) | (opening.points > domain.max)).any(axis=1)
    if outside.any():
        return (
            f"{np.count_nonzero(outside)} of the {len(outside)} places of its opening are outside the domain; "
            "move it in, or let it point inwards"
        )
    inside = np.zeros(len(opening.points), dtype=bool)
    for solid in solids:
        inside |= solid.signed_distance(opening.points) < 0.25 * spacing
    if inside.any():
        return f"{np.count_nonzero(inside)} of the {len(inside)} places of its opening are in a solid body; move it out"
    return None


def _wall_standoff(support_in_spacings: float) -> float:
    """Distance from samples at which fluid is at rest [spacings]."""
    from sim.fluid.kernels import wall_calibration  # loads Taichi, which most checks of a job do without

    return wall_calibration(support_in_spacings).standoff_in_spacings


def _best_layer(
    emitter: EmitterParameters, spacing: float, particle_volume: float
) -> tuple[NDArray[np.float64], float] | None:
    """Places in the plane of the opening [m], (n, 2), and distance of layers [m], which keep particles farthest apart.

    None where all are too near or too far.
    """
    shape = emitter.shape
    if isinstance(shape, DiscOpening):
        layers, area = _disc_layers(shape.radius, spacing), math.pi * shape.radius**2
    else:
        layers, area = _rectangle_layers(shape.size, spacing), shape.size[0] * shape.size[1]
    best, farthest = None, 0.0
    for places, nearest in layers:
        distance = len(places) * particle_volume / area
        is_possible = min(nearest, distance) >= NEAREST_IN_SPACINGS * spacing
        if is_possible and distance <= FARTHEST_IN_SPACINGS * spacing and min(nearest, distance) > farthest:
            best, farthest = (places, distance), min(nearest, distance)
    return best


def _rectangle_layers(sides: tuple[float, float], spacing: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Lattices that fit a rectangle, stretched or squeezed, and their smaller spacing."""
    for counts in product(*((math.floor(side / spacing), math.ceil(side / spacing)) for side in sides)):
        if min(counts) < 1:
            continue
        x, y = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip(counts, sides, strict=True))
        gaps = [side / n for n, side in zip(counts, sides, strict=True) if n > 1]
        yield np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2), min(gaps, default=math.inf)


def _disc_layers(radius: float, spacing: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Square lattices cut out of a disc, around one of their points or between four, and their spacing."""
    for shift in (0.0, 0.5):
        for constant in np.linspace(0.9, 1.1, LATTICES_TRIED) * spacing:
            reach = math.ceil(radius / constant) + 1
            axis = (np.arange(-reach, reach + 1) + shift) * constant
            points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
            points = points[np.hypot(points[:, 0], points[:, 1]) <= radius]
            # Its cells have to fill the disc, or the jet would be denser or thinner than the fluid.
            if len(points) and abs(math.log(len(points) * constant**2 / (math.pi * radius**2))) < CELL_MISMATCH:
                yield points, float(constant) if len(points) > 1 else math.inf


def _half_size(emitter: EmitterParameters, places: NDArray[np.float64], spacing: float) -> tuple[float, float]:
    shape = emitter.shape
    if isinstance(shape, DiscOpening):
        # The outermost particles of a disc may lie nearer to its edge, or farther from it, than half a spacing.
        radius = float(np.hypot(places[:, 0], places[:, 1]).max()) + 0.5 * spacing
        return radius, radius
    return 0.5 * shape.size[0], 0.5 * shape.size[1]


def _rim(half_size: tuple[float, ...], is_round: bool, spacing: float) -> NDArray[np.float64]:
    """Points along a circle or the sides of a rectangle, about a spacing apart [m], (n, 2)."""
    if is_round:
        angle = np.linspace(0.0, 2.0 * np.pi, math.ceil(2.0 * np.pi * half_size[0] / spacing), endpoint=False)
        return half_size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    counts = [math.ceil(2.0 * half / spacing) for half in half_size]
    x, y = (half * np.linspace(-1.0, 1.0, count, endpoint=False) for half, count in zip(half_size, counts, strict=True))
    along_x, along_y = np.stack([x, np.full_like(x, -half_size[1])], 1), np.stack([np.full_like(y, half_size[0]), y], 1)
    return np.concatenate([along_x, along_y, -along_x, -along_y])


def _axes_across(direction: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors across a direction; the first is horizontal."""
    sideways = np.cross([0.0, 0.0, 1.0], direction)
    if np.linalg.norm(sideways) < 1.0e-6:
        sideways = np.array([0.0, 1.0, 0.0])
    first = sideways / np.linalg.norm(sideways)
    return first, np.cross(direction, first)


def is_same_nozzle(one: Opening, other: Opening, spacing: float) -> bool:
    """Whether two emitters have one opening and one pipe, as when an inflow changes its speed."""

    def is_equal(own: object, others: object) -> bool:
        return bool(np.allclose(own, others, rtol=0.0, atol=SAME_IN_SPACINGS * spacing))  # type: ignore[arg-type]

    return (
        one.is_round == other.is_round
        and one.points.shape == other.points.shape
        and is_equal(one.points, other.points)
        and is_equal(one.half_size, other.half_size)
        and is_equal(spacing * one.direction, spacing * other.direction)
    )


def nozzle_collision(one: Opening, other: Opening, name: str, spacing: float) -> str | None:
    """Why an emitter cannot be in one tank with another one, of this name, or None.

    Particles of one nozzle must not be where those of the other are at the same time, as nothing would push them apart,
    and not at its pipe, which stays when its emitter has ended.
    """
    if is_same_nozzle(one, other, spacing):
        if one.start_s < other.end_s and other.start_s < one.end_s:
            return f"is the same opening as {name}, at the same time; let one start when the other has ended"
        return None
    places, others_places = one.nozzle_places(), other.nozzle_places()
    if one.start_s < other.drained_s and other.start_s < one.drained_s:
        nearest = _least_distance(places, others_places)
        if nearest < NEAREST_IN_SPACINGS * spacing:
            return f"its nozzle overlaps that of {name}, at the same time; move one of them"
    clearance = pipe_clearance(one.support_in_spacings) * spacing
    nearest = min(_least_distance(places, other.pipe(spacing)), _least_distance(others_places, one.pipe(spacing)))
    if nearest < clearance:
        return (
            f"its nozzle and that of {name} are so near that the pipe around one is in the way of the other; "
            f"move them apart by {clearance - nearest:.2g} m at least"
        )
    return None


def opening_problem(
    opening: Opening,
    spacing: float,
    domain: DomainParameters,
    solids: Sequence[Solid],
    earlier: Mapping[str, Opening],
) -> str | None:
    """Why an opening cannot be where it is, or None: it is not free, or in the way of an earlier one.

    The earlier ones are named as messages call them.
    """
    reason = obstruction(opening, spacing, domain, solids)
    for name, other in earlier.items():
        reason = reason or nozzle_collision(opening, other, name, spacing)
    return reason


def pipes(openings: Sequence[Opening], spacing: float) -> list[NDArray[np.float64]]:
    """Boundary samples of the pipes of all openings [m], (m_k, 3) each; emitters with one nozzle share its pipe."""
    return [
        opening.pipe(spacing)
        for number, opening in enumerate(openings)
        if not any(is_same_nozzle(opening, earlier, spacing) for earlier in openings[:number])
    ]


def is_felt_in_nozzles(
    positions: NDArray[np.floating], openings: Sequence[Opening], support_radius: float
) -> NDArray[np.bool_]:
    """Whether particles in any of the nozzles may feel a sample at one of these positions [m], (m, 3); (m,).

    Such samples, of pipes and of walls and bodies at rest that an opening lies in, exert no friction. A nozzle gives
    its particles their velocity once a step, but within it they are unknowns of the viscosity as all others are: held
    by samples at rest, they would brake the jet that they push.
    """
    felt = np.zeros(len(positions), dtype=np.bool_)
    for opening in openings:
        felt |= opening.distance_to_nozzle(positions) < support_radius
    return felt


def _least_distance(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """From a point of one set to a point of the other [m]."""
    return float(cKDTree(one).query(other)[0].min())
