"""The openings of emitters: which layers of particles leave them, when, where and how fast."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath, Motion, path_through
from sim.fluid.opening_layers import best_layer
from sim.shapes.openings import RectangleOpening

if TYPE_CHECKING:
    from sim.fluid.parameters import EmitterParameters, FluidParameters
    from sim.shapes.inflow import Inflow
    from sim.shapes.parameters import Placement

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
        layer = best_layer(emitter.shape, emitter.area, spacing, particle_volume)
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
    update = {
        "position": tuple(position.tolist()),
        "rotation_deg": tuple(rotation.to_degrees(rotation.product(turned, own)).tolist()),
    }
    return emitter.model_copy(update={**update, "follow": None})


def _motion_of(body: Placement | None) -> Motion:
    """A body's pose at the start, at rest; the world's own where there is none."""
    if body is None:
        return Motion(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    orientation = rotation.from_degrees(body.rotation_deg)
    return Motion(np.array(body.position, dtype=np.float64), orientation, np.zeros(3), np.zeros(3))


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
