"""Paths of kinematic bodies, with velocities that are their exact derivatives, and poses of many bodies at one time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim.core.motion import rotation
from sim.core.motion.parameters import KeyframeParameters
from sim.core.motion.rotation import Array
from sim.core.parameters import Vector3

LOOKUPS_PER_INTERVAL = 32  # of the speed between two keyframes: a parabola's crest is missed by 0.1 %


class Motion(NamedTuple):
    """Pose and velocity of the shape's origin at one time."""

    position: Array  # [m], (3,)
    orientation: Array  # unit quaternion w, x, y, z, (4,)
    velocity: Array  # [m/s], (3,)
    angular_velocity: Array  # about world axes [rad/s], (3,)

    def speed_within(self, reach: float) -> float:
        """Upper bound of the speed [m/s] of points up to `reach` [m] from the origin."""
        return float(np.linalg.norm(self.velocity) + reach * np.linalg.norm(self.angular_velocity))


@dataclass(frozen=True)
class ArcLength:
    """Upper bound of the arc length that points of a body travel, linear between times; at rest before the first."""

    times: Array  # ascending [s], (n,)
    lengths: Array  # travelled by then [m], (n,), not descending
    speed: float  # after the last time [m/s]

    def time_of_travel(self, distance: float, start_s: float) -> float:
        """Time [s] from `start_s` [s] on in which a point may travel a distance > 0 [m]; infinite if never."""
        last_s, last = float(self.times[-1]), float(self.lengths[-1])
        begun = float(np.interp(start_s, self.times, self.lengths)) + self.speed * max(start_s - last_s, 0.0)
        goal = begun + distance
        if goal < last:
            return float(np.interp(goal, self.lengths, self.times)) - start_s
        return last_s + (goal - last) / self.speed - start_s if self.speed > 0.0 else math.inf


class Path(ABC):
    """Motion of a kinematic body by time."""

    @abstractmethod
    def at(self, time_s: float) -> Motion:
        """Its motion at a simulated time [s]."""

    @abstractmethod
    def arc_length(self, reach: float) -> ArcLength:
        """Upper bound of the arc length that points up to `reach` [m] from the shape's origin travel."""

    @abstractmethod
    def hull(self) -> tuple[Array, Array]:
        """Lower and upper corner [m] of a box around all places of the shape's origin; infinite where it goes on."""

    @abstractmethod
    def _lookups(self) -> Array:
        """Times [s] whose motions stand for all others."""

    def largest_speed(self, reach: float) -> float:
        """The largest speed [m/s] that points up to `reach` [m] from the shape's origin may ever have."""
        return max(self._speeds(reach))

    def _speeds(self, reach: float) -> list[float]:
        return [self.at(float(time)).speed_within(reach) for time in self._lookups()]


class SteadyPath(Path):
    """Constant velocity and angular velocity from a starting pose."""

    def __init__(self, position: Array, orientation: Array, velocity: Array, angular_velocity: Array) -> None:
        self._start = Motion(position, orientation, velocity, angular_velocity)
        self._rests = not (velocity.any() or angular_velocity.any())

    def at(self, time_s: float) -> Motion:
        """Its motion at a simulated time [s]."""
        if self._rests:  # asked in every substep
            return self._start
        turned = rotation.exponential(time_s * self._start.angular_velocity)
        return self._start._replace(
            position=self._start.position + time_s * self._start.velocity,
            orientation=rotation.product(turned, self._start.orientation),
        )

    def arc_length(self, reach: float) -> ArcLength:
        """See `Path`."""
        return ArcLength(np.zeros(1), np.zeros(1), self.largest_speed(reach))

    def hull(self) -> tuple[Array, Array]:
        """See `Path`."""
        place, velocity = self._start.position, self._start.velocity
        return np.where(velocity < 0.0, -np.inf, place), np.where(velocity > 0.0, np.inf, place)

    def _lookups(self) -> Array:
        return np.zeros(1)


class KeyframePath(Path):
    """A path through keyframes; at rest before the first and after the last.

    Positions are cubic Hermite splines with the tangents of a parabola through three neighbours (Catmull-Rom on
    uneven times). Orientations are the cumulative Bézier form of the same on unit quaternions (Kim, Kim & Shin 1995,
    "A general construction scheme for unit quaternion curves with simple high order derivatives"). Both are once
    continuously differentiable, the two ends included, where velocities are zero. Linear paths run straight, and
    along great arcs (slerp), at constant velocity in every interval.

    Args:
        times: ascending [s], (n,).
        positions: [m], (n, 3).
        orientations: unit quaternions, (n, 4); neighbours are joined by the shorter arc.
        linear: whether velocities are constant between keyframes.
    """

    def __init__(self, times: Sequence[float], positions: Array, orientations: Array, *, linear: bool) -> None:
        self._times = np.asarray(times, dtype=np.float64)
        self._positions, self._orientations, self._linear = positions, orientations, linear
        # Rotation vectors from one keyframe to the next in the axes of the first, which are also those of the second.
        self._turns = rotation.logarithm(rotation.product(rotation.conjugate(orientations[:-1]), orientations[1:]))
        self._velocities = self._tangents(np.diff(positions, axis=0))
        self._angular_velocities = self._tangents(self._turns)

    @property
    def times(self) -> Array:
        """Of its keyframes [s], (n,)."""
        return self._times

    def at(self, time_s: float) -> Motion:
        """Its motion at a simulated time [s]."""
        if time_s < self._times[0] or time_s >= self._times[-1]:
            end = 0 if time_s < self._times[0] else -1
            return Motion(self._positions[end].copy(), self._orientations[end].copy(), np.zeros(3), np.zeros(3))
        k = int(np.searchsorted(self._times, time_s, side="right")) - 1
        span = float(self._times[k + 1] - self._times[k])
        s = (time_s - float(self._times[k])) / span
        turn, step = self._turns[k], self._positions[k + 1] - self._positions[k]
        if self._linear:
            orientation = rotation.product(self._orientations[k], rotation.exponential(s * turn))
            spin = rotation.rotated(self._orientations[k], turn / span)
            return Motion(self._positions[k] + s * step, orientation, step / span, spin)
        position, velocity = self._hermite(k, s, span)
        orientation, spin = self._bezier(k, s, span)
        return Motion(position, orientation, velocity, spin)

    def arc_length(self, reach: float) -> ArcLength:
        """See `Path`; between look-ups the larger speed counts."""
        times, speeds = self._lookups(), np.array(self._speeds(reach))
        lengths = np.cumsum(np.maximum(speeds[1:], speeds[:-1]) * np.diff(times))
        return ArcLength(times, np.append(0.0, lengths), 0.0)

    def hull(self) -> tuple[Array, Array]:
        """See `Path`; as far as look-ups tell."""
        places = np.stack([self.at(float(time)).position for time in self._lookups()])
        return places.min(axis=0), places.max(axis=0)

    def _lookups(self) -> Array:
        """Times in every interval, its start included, and the end [s]."""
        shares = np.arange(LOOKUPS_PER_INTERVAL) / LOOKUPS_PER_INTERVAL
        inner = (self._times[:-1, None] + shares * np.diff(self._times)[:, None]).ravel()
        return np.append(inner, self._times[-1])

    def _tangents(self, steps: Array) -> Array:
        """Derivatives at the keyframes, (n, 3), from the steps between them (n - 1, 3)."""
        tangents = np.zeros((len(self._times), 3))
        spans = np.diff(self._times)[:, None]
        slopes = steps / spans
        tangents[1:-1] = (spans[1:] * slopes[:-1] + spans[:-1] * slopes[1:]) / (spans[1:] + spans[:-1])
        return tangents

    def _hermite(self, k: int, s: float, span: float) -> tuple[Array, Array]:
        step = self._positions[k + 1] - self._positions[k]
        start, end = span * self._velocities[k], span * self._velocities[k + 1]
        bend = 3.0 * step - 2.0 * start - end
        twist = start + end - 2.0 * step
        position = self._positions[k] + s * (start + s * (bend + s * twist))
        return position, (start + s * (2.0 * bend + 3.0 * s * twist)) / span

    def _bezier(self, k: int, s: float, span: float) -> tuple[Array, Array]:
        """q(s) = q_k exp(b1 w1) exp(b2 w2) exp(b3 w3), with cumulative Bernstein polynomials b of degree 3."""
        first, last = span * self._angular_velocities[k] / 3.0, span * self._angular_velocities[k + 1] / 3.0
        without_ends = rotation.product(
            rotation.exponential(-first),
            rotation.product(rotation.exponential(self._turns[k]), rotation.exponential(-last)),
        )
        vectors = np.stack([first, rotation.logarithm(without_ends), last])
        weights = (1.0 - (1.0 - s) ** 3, s * s * (3.0 - 2.0 * s), s**3)
        rates = (3.0 * (1.0 - s) ** 2, 6.0 * s * (1.0 - s), 3.0 * s * s)
        orientation, spin = self._orientations[k], np.zeros(3)
        for vector, weight, rate in zip(vectors, weights, rates, strict=True):
            # A factor turns about its own fixed vector, given in the axes reached by the factors before it.
            spin = spin + rotation.rotated(orientation, rate * vector)
            orientation = rotation.product(orientation, rotation.exponential(weight * vector))
        return rotation.normalized(orientation), spin / span


def path_onwards(
    now: Motion, time_s: float, position: Vector3, rotation_deg: Vector3 | None, within_s: float
) -> KeyframePath:
    """From a pose at a time [s] straight to another, or the same orientation if omitted, in so many seconds; then rest.

    What was sized when the scene was built, such as the speeds that a fluid expects of bodies, does not follow it.

    Raises:
        ValueError: the pose is not finite, or the way takes no time.
    """
    if not (np.isfinite([*position, *(rotation_deg or ())]).all() and 0.0 < within_s < np.inf):
        turn = "" if rotation_deg is None else f", {tuple(rotation_deg)} degrees"
        raise ValueError(
            f"a finite pose in more than 0 s is needed, got {tuple(position)} m{turn} within {within_s:g} s"
        )
    orientation = now.orientation if rotation_deg is None else rotation.from_degrees(rotation_deg)
    times, orientations = [time_s, time_s + within_s], np.stack([now.orientation, orientation])
    return KeyframePath(times, np.stack([now.position, np.asarray(position)]), orientations, linear=True)


def path_through(keyframes: Sequence[KeyframeParameters], *, linear: bool) -> KeyframePath:
    """The path through keyframes as a job file names them."""
    return KeyframePath(
        [keyframe.time_s for keyframe in keyframes],
        np.array([keyframe.position for keyframe in keyframes], dtype=np.float64),
        np.stack([rotation.from_degrees(keyframe.rotation_deg) for keyframe in keyframes]),
        linear=linear,
    )


@dataclass(frozen=True, eq=False)
class Poses:
    """Where all bodies are: the moving ones, the static ones, and last the domain, which walls belong to."""

    position: Array  # centres of mass [m], (n, 3)
    rotation: Array  # body axes to world axes, (n, 3, 3)
