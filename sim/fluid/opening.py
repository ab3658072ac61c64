"""The openings of emitters: the layers of particles in them, where these leave, and what is in the way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath, Motion, path_through
from sim.fluid.parameters import DiscOpening, RectangleOpening
from sim.shapes.section import Section, section_of

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.inflow import Inflow
    from sim.fluid.parameters import EmitterParameters, FluidParameters
    from sim.shapes.parameters import Placement
    from sim.shapes.solid import Solid

NEAREST_IN_SPACINGS, FARTHEST_IN_SPACINGS = 0.82, 1.35  # of particles and of layers: nearer, they would burst out
LATTICE_CONSTANTS = 1.1, 0.9  # spacings of lattices that are cut to an opening [spacings], largest and smallest
LATTICES_TRIED = 41  # of them
SAME_IN_SPACINGS = 1.0e-3  # openings whose particles differ by less are one
MOUTH_IN_SPACINGS = 0.75  # how far from a place in an opening samples of a wall are in its mouth
MANY = 2**53  # particles or layers that no emitter comes to


@dataclass(frozen=True, eq=False)
class Opening:
    """An opening, from which layers of particles leave one after the other.

    Its axes are two across the flow and the direction of that, in the world, or along those of the body that it
    follows. A layer leaves when the fluid has come as far as the layer is thick, and its volume is just outside then.
    """

    centre: NDArray[np.float64]  # [m], (3,)
    axes: NDArray[np.float64]  # unit vectors in rows, the last is where the fluid flows, (3, 3)
    places: NDArray[np.float64]  # of the particles of a layer, along the first two axes [m], (n, 2)
    half_size: tuple[float, float]  # half the sides of a box around what a layer fills, along these axes [m]
    layer_distance: float  # a layer's volume over the opening's area [m], so that the flow is exactly speed times area
    inflow: Inflow  # how far the fluid has come at each time
    path: KeyframePath | None  # of its centre, where it has keyframes
    follow: str | None  # name of the moving body that it is fixed to
    placement: Motion  # of that body at the start; the world's origin at rest where there is none

    @classmethod
    def of(
        cls,
        emitter: EmitterParameters,
        spacing: float,
        particle_volume: float,
        body: Placement | None = None,
    ) -> Opening:
        """The opening of an emitter, on a body if it follows one, for particles of a spacing [m] and volume [m³].

        Raises:
            ValueError: it is too narrow for them; as a ShapeError where its shape cannot be built.
        """
        layer = _best_layer(emitter, spacing, particle_volume)
        if layer is None:
            raise ValueError(
                f"is too narrow for particles {spacing:g} m apart; enlarge it or use a smaller particle_radius"
            )
        places, distance = layer
        axes = rotation.rotated(rotation.from_degrees(emitter.rotation_deg), _axes_along(emitter.direction))
        path = None
        if emitter.keyframe:
            path = path_through(emitter.keyframe, linear=emitter.interpolation == "linear")
            axes = _axes_along(emitter.direction)
        return cls(
            centre=np.zeros(3) if path is not None else np.array(emitter.position, dtype=np.float64),
            axes=axes,
            places=places,
            half_size=_half_size(emitter, places, spacing),
            layer_distance=distance,
            inflow=emitter.inflow,
            path=path,
            follow=emitter.follow,
            placement=_motion_of(body),
        )

    @property
    def moves(self) -> bool:
        """Whether it may be elsewhere later."""
        return self.path is not None or self.follow is not None

    @property
    def speed(self) -> float:
        """Largest of the inflow [m/s], relative to the opening."""
        return self.inflow.largest_speed

    @property
    def start_s(self) -> float:
        """When it begins to emit [s]."""
        return self.inflow.start_s

    @property
    def end_s(self) -> float:
        """When it stops [s]; infinite if never."""
        return self.inflow.end_s

    @property
    def total_particles(self) -> float:
        """Particles of all its layers; infinite where it never ends."""
        travel = self.inflow.total_travel
        return math.inf if math.isinf(travel) else float(round(travel / self.layer_distance * len(self.places)))

    def layers_due(self, time_s: float) -> int:
        """Layers that have left the opening by a time [s]: all, to a particle, at its end, and whole ones before."""
        total = min(self.total_particles, MANY)
        if time_s >= self.end_s:
            return math.ceil(total / len(self.places))
        passed = self.inflow.travel_at(time_s) / self.layer_distance * (1.0 + 1.0e-12)
        # The first layer is what is left of the particles when all others are whole.
        return math.floor(passed + 1.0 - self.count_of(0) / len(self.places))

    def count_of(self, layer: int) -> int:
        """Particles of a layer; the first has fewer where all of them are no whole number of layers."""
        whole, total = len(self.places), self.total_particles
        if layer > 0 or math.isinf(total) or total == 0.0:
            return whole
        return int(total - 1) % whole + 1

    def particles_due(self, time_s: float) -> int:
        """Particles of the layers that have left by a time [s]."""
        layers = self.layers_due(time_s)
        return 0 if layers == 0 else self.count_of(0) + (layers - 1) * len(self.places)

    def leaves_at(self, layer: int) -> float:
        """Time when a layer leaves [s]."""
        passed = layer + self.count_of(0) / len(self.places)
        return min(self.inflow.time_of(passed * self.layer_distance), self.end_s)

    def places_of(self, layer: int) -> NDArray[np.float64]:
        """Where particles of a layer are as it leaves, along all axes from the centre [m], (m, 3)."""
        count, whole = self.count_of(layer), len(self.places)
        chosen = self.places[(np.arange(count) * whole + whole // 2) // count % whole] if count < whole else self.places
        # Half a layer in front of the opening: its volume is then wholly outside.
        return np.pad(chosen, ((0, 0), (0, 1)), constant_values=0.5 * self.layer_distance)

    def motion(self, time_s: float, body: Motion | None = None) -> Motion:
        """Pose of the body or the path that carries it at a time [s]; the body's own at the start if not given."""
        if self.path is not None:
            return self.path.at(time_s)
        return self.placement if body is None else body

    def points(self, layer: int = 0, time_s: float = 0.0, body: Motion | None = None) -> NDArray[np.float64]:
        """Where particles of a layer are in the world as it leaves at a time [s] [m], (m, 3)."""
        return self.to_world(self.places_of(layer), self.motion(time_s, body))

    def to_world(self, own: NDArray[np.float64], carrier: Motion) -> NDArray[np.float64]:
        """Points along its axes from its centre, in the world [m], (m, 3)."""
        return carrier.position + rotation.rotated(carrier.orientation, self.centre + own @ self.axes)

    def to_own(self, points: NDArray[np.floating], carrier: Motion) -> NDArray[np.float64]:
        """Points of the world along its axes from its centre [m], (m, 3)."""
        unturned = rotation.rotated(rotation.conjugate(carrier.orientation), points - carrier.position)
        return (unturned - self.centre) @ self.axes.T

    def direction(self, carrier: Motion) -> NDArray[np.float64]:
        """Unit vector along the inflow in the world, (3,)."""
        return rotation.rotated(carrier.orientation, self.axes[2])

    def velocity_at(self, points: NDArray[np.float64], carrier: Motion, speed: float) -> NDArray[np.float64]:
        """Velocity of what flows out at points of the world at a speed [m/s], (m, 3) [m/s]."""
        arms = points - carrier.position
        return carrier.velocity + rotation.cross(carrier.angular_velocity, arms) + speed * self.direction(carrier)

    @property
    def first_jet(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Its middle [m] and the largest velocity of the inflow [m/s] where it is at the start, (3,) each."""
        return self.to_world(np.zeros((1, 3)), self.motion(0.0))[0], self.speed * self.direction(self.motion(0.0))

    def outflow(self, body_speed: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places where fluid flows out [m], (m, 3), and velocities as large as they may get there [m/s], (m, 3).

        They are at the start, and at each keyframe; a body that it follows may have a speed of its own [m/s].
        """
        motions, carried = [self.placement], body_speed if self.follow is not None else 0.0
        if self.path is not None:
            motions = [self.path.at(float(time)) for time in self.path.times]
            carried = self.path.largest_speed(float(np.hypot(*self.half_size)))
        points = np.concatenate([self.to_world(self.places_of(1), motion) for motion in motions])
        velocity = (self.speed + carried) * self.direction(motions[0])
        return points, np.broadcast_to(velocity, points.shape)

    def is_behind(
        self, points: NDArray[np.floating], carrier: Motion, spacing: float, depth: float
    ) -> NDArray[np.bool_]:
        """Which points of the world [m], (m, 3), are in its mouth or behind it, down to a depth [m], (m,)."""
        own = self.to_own(points, carrier)
        nearest, _ = cKDTree(self.places).query(own[:, :2], distance_upper_bound=MOUTH_IN_SPACINGS * spacing)
        return np.isfinite(nearest) & (own[:, 2] > -depth) & (own[:, 2] < 0.0)


def openings_of(
    fluids: Sequence[FluidParameters],
    particle_volume: float | None = None,
    bodies: Mapping[str, Placement] | None = None,
) -> list[tuple[int, Opening]]:
    """Number of its fluid and opening of each emitter, for particles of a volume [m³]; that of the lattice if omitted.

    The bodies that emitters follow stand by name.

    Raises:
        ValueError: one is too narrow.
    """
    return [
        (number, Opening.of(emitter, fluid.spacing, particle_volume or fluid.lattice_volume, followed(emitter, bodies)))
        for number, fluid in enumerate(fluids)
        for emitter in fluid.emitter
    ]


def followed(emitter: EmitterParameters, bodies: Mapping[str, Placement] | None) -> Placement | None:
    """The body that an emitter follows, of those by name; None if there is none."""
    return None if emitter.follow is None or bodies is None else bodies.get(emitter.follow)


def placed_on(emitter: EmitterParameters, body: Placement) -> EmitterParameters:
    """The emitter where it is in the world with a body that stands still."""
    turned, own = rotation.from_degrees(body.rotation_deg), rotation.from_degrees(emitter.rotation_deg)
    position = np.asarray(body.position) + rotation.rotated(turned, np.asarray(emitter.position))
    update = {"position": tuple(position.tolist()), "rotation_deg": rotation.to_degrees(rotation.product(turned, own))}
    return emitter.model_copy(update={**update, "follow": None})


def obstruction(opening: Opening, spacing: float, domain: DomainParameters, solids: Sequence[Solid]) -> str | None:
    """Why fluid cannot enter here, or None: particles of the opening outside the domain, or in a solid."""
    points = opening.points(1, opening.start_s)
    outside = ((points < domain.min) | (points > domain.max)).any(axis=1)
    if outside.any():
        return (
            f"{np.count_nonzero(outside)} of the {len(outside)} places of its opening are outside the domain; "
            "move it in, or let it point inwards"
        )
    inside = np.zeros(len(points), dtype=bool)
    for solid in solids:
        inside |= solid.signed_distance(points) < 0.25 * spacing
    if inside.any():
        return f"{np.count_nonzero(inside)} of the {len(inside)} places of its opening are in a solid body; move it out"
    return None


def _motion_of(body: Placement | None) -> Motion:
    """A body's pose at the start, at rest; the world's own where there is none."""
    if body is None:
        return Motion(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    orientation = rotation.from_degrees(body.rotation_deg)
    return Motion(np.array(body.position, dtype=np.float64), orientation, np.zeros(3), np.zeros(3))


def _best_layer(
    emitter: EmitterParameters, spacing: float, particle_volume: float
) -> tuple[NDArray[np.float64], float] | None:
    """Places in the plane of the opening [m], (n, 2), and distance of layers [m], which keep particles farthest apart.

    None where all are too near or too far.
    """
    shape, area = emitter.shape, emitter.area
    if isinstance(shape, RectangleOpening):
        layers = _rectangle_layers(shape.size, spacing)
    elif isinstance(shape, DiscOpening):
        layers = _cut_layers(_disc(shape.radius), area, spacing)
    else:
        layers = _cut_layers(section_of(shape), area, spacing)
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


def _cut_layers(section: Section, area: float, spacing: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Square lattices cut out of a section of an area [m²], around one of their points or between four, and spacings.

    Their cells have exactly that area in all: the jet would be denser or thinner than the fluid otherwise.
    """
    fewest, most = (math.ceil(area / (limit * spacing) ** 2) for limit in LATTICE_CONSTANTS)
    counts = np.unique(np.linspace(max(fewest, 1), max(most, 1), LATTICES_TRIED).round().astype(int))
    for count, *shift in product(counts, (0.0, 0.5), (0.0, 0.5)):
        constant = math.sqrt(area / count)
        reach = np.ceil(section.half_size / constant).astype(int) + 1
        x, y = ((np.arange(-end, end + 1) + own) * constant for end, own in zip(reach, shift, strict=True))
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        depth = section.depth(points)
        order = np.argsort(-depth, kind="stable")
        last, next_ = depth[order[count - 1]], depth[order[count]]
        # Those at one depth, such as four around the middle of a disc, belong together.
        if last >= 0.0 and last - next_ > SAME_IN_SPACINGS * spacing:
            yield points[np.sort(order[:count])], constant if count > 1 else math.inf


def _disc(radius: float) -> Section:
    return Section(
        np.full(2, radius), lambda points: radius - np.hypot(points[:, 0], points[:, 1]), math.pi * radius**2
    )


def _half_size(emitter: EmitterParameters, places: NDArray[np.float64], spacing: float) -> tuple[float, float]:
    if isinstance(emitter.shape, RectangleOpening):
        return 0.5 * emitter.shape.size[0], 0.5 * emitter.shape.size[1]
    # The outermost particles of a lattice that is cut may lie nearer to the edge, or farther, than half a spacing.
    first, second = np.abs(places).max(axis=0) + 0.5 * spacing
    return float(first), float(second)


def _axes_along(direction: Sequence[float]) -> NDArray[np.float64]:
    """Two unit vectors across a direction, the first of them horizontal, and one along it, in rows, (3, 3)."""
    along = np.array(direction, dtype=np.float64) / np.linalg.norm(direction)
    sideways = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(sideways) < 1.0e-6:
        sideways = np.array([0.0, 1.0, 0.0])
    first = sideways / np.linalg.norm(sideways)
    return np.stack([first, np.cross(along, first), along])


def is_same_opening(one: Opening, other: Opening, spacing: float) -> bool:
    """Whether two emitters have one opening that rests, or rests on one body, as when an inflow changes its speed."""
    return (
        _move_alike(one, other)
        and one.places.shape == other.places.shape
        and bool(np.allclose(one.points(1), other.points(1), rtol=0.0, atol=SAME_IN_SPACINGS * spacing))
    )


def _move_alike(one: Opening, other: Opening) -> bool:
    """Whether two openings always are where they are at the start, as seen from each other."""
    return one.path is None and other.path is None and one.follow == other.follow


def opening_collision(one: Opening, other: Opening, name: str, spacing: float) -> str | None:
    """Why an emitter cannot be in one tank with another one, of this name, or None.

    Layers that leave one must not be where those of the other do at the same time, as they would take their places.
    """
    if not _move_alike(one, other) or one.start_s >= other.end_s or other.start_s >= one.end_s:
        return None
    if is_same_opening(one, other, spacing):
        return f"is the same opening as {name}, at the same time; let one start when the other has ended"
    if float(cKDTree(one.points(1)).query(other.points(1))[0].min()) < NEAREST_IN_SPACINGS * spacing:
        return f"its opening overlaps that of {name}, at the same time; move one of them"
    return None


def opening_problem(
    opening: Opening,
    spacing: float,
    domain: DomainParameters,
    solids: Sequence[Solid],
    earlier: Mapping[str, Opening],
) -> str | None:
    """Why an opening cannot be where it is, or None: it is not free, or in the way of an earlier one.

    The earlier ones are named as messages call them. Of one that moves only the start counts, and not if it follows a
    body that has time to carry it elsewhere before it begins.
    """
    is_elsewhere = opening.follow is not None and opening.start_s > 0.0
    reason = None if is_elsewhere else obstruction(opening, spacing, domain, solids)
    for name, other in earlier.items():
        reason = reason or opening_collision(opening, other, name, spacing)
    return reason
