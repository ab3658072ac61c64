"""What a mouse holds: bodies and nodes of cloth that follow it, smoothly and never faster than contacts can follow."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FOLLOWING_RATE = 15.0
"""How fast what is held comes after the mouse [1/s]: critically damped, most of the way in 0.2 s."""

LARGEST_SPEED = 3.0
"""Hands are no faster [m/s]: a body gets 2.5 mm on in a substep of cloth then, and a mouse jumps at will."""

SPIN_DECAY = 6.0
"""What is held stops turning at this rate [1/s]."""

AT_REST = 1.0e-6
"""Closer to the mouse than this [m], what is led is left where it is."""


class Hand(Protocol):
    """Something held.

    Attributes:
        target: where the mouse wants it [m], (3,).
    """

    target: Vector

    def move(self, dt: float) -> None:
        """Before a frame of dt [s]."""

    def release(self) -> None:
        """Let it go."""


def towards(target: Vector, position: Vector, velocity: Vector, dt: float) -> Vector:
    """Velocity [m/s] in the next dt [s] of what follows a target, (3,): a critically damped spring, implicitly."""
    rate = FOLLOWING_RATE * dt
    wanted: Vector = (velocity + rate * FOLLOWING_RATE * (target - position)) / (1.0 + rate) ** 2
    speed = float(np.linalg.norm(wanted))
    return wanted * min(1.0, LARGEST_SPEED / speed) if speed > 0.0 else wanted


class FreeBody:
    """A dynamic body on a spring without weight: what it hits pushes back, and let go it flies on."""

    def __init__(self, rigid: Any, number: int, *, arm: Vector) -> None:
        """Hold body `number` at a point `arm` [m], (3,), from its centre of mass."""
        self._rigid, self._number, self._arm = rigid, number, arm
        self.target: Vector = rigid.bodies.position[number] + arm

    def move(self, dt: float) -> None:
        """Push it once for the whole frame; gravity's share of it included."""
        bodies, number = self._rigid.bodies, self._number
        velocity = bodies.velocity[number]
        fall = 0.5 * dt * self._rigid.gravity  # from the mean of a frame's velocities to the one at its end
        wanted = towards(self.target - self._arm, bodies.position[number], velocity - fall, dt) - fall
        linear, angular = np.zeros((2, len(bodies), 3))
        linear[number] = bodies.mass[number] * (wanted - velocity)
        angular[number] = -(1.0 - np.exp(-SPIN_DECAY * dt)) * bodies.angular_momentum()[number]
        bodies.apply_impulses(linear, angular)

    def release(self) -> None:
        """It goes on with the velocity that it has."""


class LedBody:
    """A kinematic body, which moves whatever it hits; let go it stays."""

    def __init__(self, rigid: Any, number: int, *, arm: Vector) -> None:
        """Hold body `number` at a point `arm` [m], (3,), from its origin."""
        self._rigid, self._number, self._arm = rigid, number, arm
        self._velocity = np.zeros(3)
        self.target: Vector = self._position() + arm

    def _position(self) -> Vector:
        position: Vector = self._rigid.paths[self._number].at(self._rigid.time_s).position
        return position

    def move(self, dt: float) -> None:
        """Lead it on for a frame."""
        position = self._position()
        self._velocity = towards(self.target - self._arm, position, self._velocity, dt)
        ends = tuple(float(each) for each in position + dt * self._velocity)
        self._rigid.lead(self._rigid.bodies.names[self._number], ends, within_s=dt)

    def release(self) -> None:
        """It stays where it is: its path of one frame is over."""


class Nodes:
    """Nodes of a cloth, led as one; let go they fly on, unless they are a pin's.

    Attributes:
        nodes: that are held, in the numbers of the cloth, (k,).
    """

    def __init__(self, cloth: Any, name: str, nodes: NDArray[np.int64], *, stays: bool) -> None:
        """Hold nodes of the cloth of this name; `stays`: for ever, as a pin does."""
        self._cloth, self._name, self.nodes, self._stays = cloth, name, nodes, stays
        first = cloth.state.host.first_node[cloth.state.names.index(name)]
        self._place: Vector = cloth.state.positions()[first + nodes].mean(axis=0)
        self._velocity = np.zeros(3)
        self.target: Vector = self._place.copy()
        cloth.hold(name, nodes.tolist())

    def move(self, dt: float) -> None:
        """Lead them on for a frame."""
        self._velocity = towards(self.target, self._place, self._velocity, dt)
        shift = dt * self._velocity
        if float(np.linalg.norm(shift)) < AT_REST:
            return
        self._cloth.hold(self._name, self.nodes.tolist(), shift=tuple(map(float, shift)), within_s=dt)
        self._place = self._place + shift

    def release(self) -> None:
        """Let them fly on with the velocity that they have, or stay pinned."""
        if self._stays:
            self._cloth.hold(self._name, self.nodes.tolist())
        else:
            self._cloth.let_go(self._name, self.nodes.tolist())
