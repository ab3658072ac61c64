"""Where sources that move are: along keyframes, or on a rigid body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath, Motion, path_through

if TYPE_CHECKING:
    from sim.smoke.parameters import SmokeSourceParameters

Array = NDArray[np.float64]


class SourceMotion(Protocol):
    """How a source moves."""

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """Its motion at times so close that it leaves no gap.

        Args:
            begin_s, end_s: the span of time [s], which a step of the smoke contains.
            spacing: largest way of any of its points from one of the poses to the next [m].

        Returns:
            From the beginning to the end, one at least.
        """

    def speed(self) -> float:
        """Bound of the speed of its points in the coming step [m/s]."""


class PathMotion:
    """Along a path that is known ahead."""

    def __init__(self, path: KeyframePath, reach: float) -> None:
        """Take the path of the shape's origin, from which its points are no farther than the reach [m]."""
        self._path, self._way, self._speed = path, path.arc_length(reach), path.largest_speed(reach)

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """See `SourceMotion`."""
        begun, ended = np.interp([begin_s, end_s], self._way.times, self._way.lengths)
        return [self._path.at(time) for time in _times(begin_s, end_s, float(ended - begun), spacing)]

    def speed(self) -> float:
        """The largest of the whole path [m/s]."""
        return self._speed


@dataclass(frozen=True)
class _Leg:
    """A body's motion at the beginning and at the end of a step."""

    begin_s: float
    end_s: float
    begin: Motion
    end: Motion


class BodyMotion:
    """Fixed to a rigid body, which someone else tells the motion of, step by step.

    Between the two ends of a step the body is taken to go straight and to turn about one axis.
    """

    def __init__(self, offset: Array, orientation: Array, reach: float) -> None:
        """Take the source's origin from that of the body's shape [m], (3,), its turn, (4,), and its reach [m]."""
        self._offset, self._orientation = offset, orientation
        self._arm = reach + float(np.linalg.norm(offset))
        self.stay(Motion(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3)))

    def stay(self, body: Motion) -> None:
        """The body is here: at the start, or where a run continues."""
        self._leg = _Leg(0.0, 0.0, body, body)

    def carry(self, body: Motion, begin_s: float, end_s: float) -> None:
        """In the coming step of the smoke, from one time to another [s], the body gets here."""
        self._leg = _Leg(begin_s, end_s, self._leg.end, body)

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """See `SourceMotion`."""
        leg = self._leg
        duration = leg.end_s - leg.begin_s
        if duration <= 0.0:
            return [self._on(leg.end)]
        turn = rotation.logarithm(rotation.product(leg.end.orientation, rotation.conjugate(leg.begin.orientation)))
        step = leg.end.position - leg.begin.position
        length = (float(np.linalg.norm(step)) + self._arm * float(np.linalg.norm(turn))) * (end_s - begin_s) / duration
        poses = []
        for time in _times(begin_s, end_s, length, spacing):
            part = (time - leg.begin_s) / duration
            body = Motion(
                leg.begin.position + part * step,
                rotation.product(rotation.exponential(part * turn), leg.begin.orientation),
                leg.begin.velocity + part * (leg.end.velocity - leg.begin.velocity),
                leg.begin.angular_velocity + part * (leg.end.angular_velocity - leg.begin.angular_velocity),
            )
            poses.append(self._on(body))
        return poses

    def speed(self) -> float:
        """At the end of the last step [m/s]."""
        body = self._leg.end
        return float(np.linalg.norm(body.velocity)) + self._arm * float(np.linalg.norm(body.angular_velocity))

    def _on(self, body: Motion) -> Motion:
        arm = rotation.rotated(body.orientation, self._offset)
        return Motion(
            body.position + arm,
            rotation.product(body.orientation, self._orientation),
            body.velocity + np.cross(body.angular_velocity, arm),
            body.angular_velocity,
        )


def motion_of(source: SmokeSourceParameters, reach: float) -> SourceMotion | None:
    """How a source moves, with points up to `reach` [m] from its origin; None if it stays where it is."""
    if source.follow is not None:
        return BodyMotion(np.asarray(source.position, float), rotation.from_degrees(source.rotation_deg), reach)
    if not source.keyframe:
        return None
    return PathMotion(path_through(source.keyframe, linear=source.interpolation == "linear"), reach)


def _times(begin_s: float, end_s: float, length: float, spacing: float) -> list[float]:
    """Times from beginning to end [s] so many that a way of a length [m] is cut into parts of a spacing [m]."""
    if length <= 0.0 or end_s <= begin_s:
        return [end_s]
    count = max(1, math.ceil(length / spacing))
    return [begin_s + (end_s - begin_s) * number / count for number in range(count + 1)]
