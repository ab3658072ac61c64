"""The air around rigid bodies that somebody computes: its pressure, and the weight of what bodies displace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.rotation import Array
from sim.core.solver import Arrays
from sim.rigid.air import FELT_ASLEEP
from sim.rigid.glue import Glue
from sim.rigid.states import MovingBodies, lengths
from sim.shapes.body_geometry import BodyGeometry

NOWHERE = -1  # number of the air of a body that is in none

HELD = "air_push"  # names in a checkpoint
YIELDING = "air_yield"
FELT = "air_felt"


@dataclass(frozen=True)
class AirBox:
    """A box of air, without end where its corners are infinite; part of it is computed, elsewhere air is at rest."""

    low: Array  # lower corner [m], (3,)
    high: Array
    density: float  # [kg/m³]
    computed: Callable[[], tuple[Sequence[float], Sequence[float]]]  # corners now of what is [m]

    def has(self, places: Array) -> NDArray[np.bool_]:
        """Which of some places [m], (n, 3), are in it."""
        return _between(places, self.low, self.high)

    def computes(self, places: Array) -> NDArray[np.bool_]:
        """Which of some places [m], (n, 3), are in what is computed."""
        return _between(places, *self.computed())


def _between(places: Array, low: Array | Sequence[float], high: Array | Sequence[float]) -> NDArray[np.bool_]:
    result: NDArray[np.bool_] = ((places >= np.asarray(low)) & (places <= np.asarray(high))).all(axis=1)
    return result


class Surroundings:
    """What air does to bodies between two looks at it; a body is in the first box that its centre of mass is in.

    Pressure is told at the end of each step of the air, as impulses. They act at once, and what acts in the next step
    is foreseen to be the same: it is given little by little, so that contacts and paths are those of a steady force,
    and the air takes it back when it tells what it really was (`settle`). Velocities after each step of the air are
    those that its impulses give, to rounding.

    What bodies displace lifts them by its weight, at its centre. Bodies that rest sleep under pressure below
    `FELT_ASLEEP` of gravity alone; of those that wake nothing is foreseen until the air has seen them move. Pieces that
    hold together feel the air as one.

    Attributes:
        boxes: of air, in the order in which bodies look for theirs.
    """

    def __init__(self, bodies: MovingBodies, solids: Sequence[BodyGeometry], glue: Glue | None) -> None:
        n = len(bodies)
        self.boxes: list[AirBox] = []
        self._bodies, self._glue = bodies, glue
        displaced = [solid.displaced for solid in solids]
        self._volume = np.array([volume for volume, _ in displaced])
        self._centre = np.array([centre for _, centre in displaced])
        # Accelerations [m/s²], [1/s²] by the pressure, raw and as far as joints let bodies yield, (n, 6) each.
        self._held, self._yielding = np.zeros((n, 6)), np.zeros((n, 6))
        self._given = np.zeros((n, 6))  # of the latter since the air was last looked at [m/s], [1/s]
        self._felt = np.zeros(n)  # size of the pressure's acceleration, of those asleep as well [m/s²]

    def where(self) -> NDArray[np.int64]:
        """Number of the box that each body is in, pieces that hold together as one, or `NOWHERE`, (n,)."""
        place = self._movers.position[self._leader]
        found = np.full(len(place), NOWHERE)
        for number, box in reversed(list(enumerate(self.boxes))):
            found[box.has(place)] = number
        return found

    def surrounded(self) -> NDArray[np.bool_]:
        """Whether each body is where the air of its box is computed now, (n,)."""
        place, where = self._movers.position[self._leader], self.where()
        result = np.zeros(len(place), dtype=bool)
        for number, box in enumerate(self.boxes):
            result |= (where == number) & box.computes(place)
        return result

    def push(self, gravity: Array, dt: float) -> None:
        """Let air act on dynamic bodies for dt [s]."""
        bodies, where = self._bodies, self.where()
        bodies.wake(bodies.is_asleep & self.stirs(gravity))
        moves = (bodies.is_free & ~bodies.is_asleep & (where != NOWHERE))[:, None]
        density = np.array([*(box.density for box in self.boxes), 0.0])[where]
        force = -(density * self._volume)[:, None] * gravity
        arms = np.einsum("nij,nj->ni", bodies.rotation(), self._centre)
        turning = np.einsum("nij,nj->ni", bodies.inverse_inertia(), rotation.cross(arms, force))
        lift = np.concatenate([bodies.inverse_mass[:, None] * force, turning], axis=1)
        self._given = self._given + np.where(moves, dt * self._yielding, 0.0)
        self._change(np.where(moves, dt * (self._held + lift), 0.0))

    def stirs(self, gravity: Array) -> NDArray[np.bool_]:
        """Whether air lets bodies not sleep, (n,)."""
        result: NDArray[np.bool_] = self._felt > FELT_ASLEEP * np.linalg.norm(gravity)
        return result

    def forget(self, which: NDArray[np.bool_]) -> None:
        """Foresee nothing of bodies, (n,), and do not take back what was: they have been stopped."""
        self._held[which] = self._yielding[which] = self._given[which] = 0.0

    def velocities(self) -> tuple[Array, Array]:
        """Velocities [m/s] and spins [1/s] without what was foreseen since the air was last looked at, (n, 3) each."""
        return self._bodies.velocity - self._given[:, :3], self._bodies.angular_velocity - self._given[:, 3:]

    def settle(self, number: int, impulses: Array, mobility: tuple[Array, Array], dt: float) -> None:
        """Take the impulses of a box in its step of dt [s] in place of what was foreseen.

        Args:
            number: of the box.
            impulses: on what moves as one, by its leader [N s], and about its centre [N m s], (n, 6).
            mobility: how easily it yields (`RigidSolver.mobility`).
            dt: [s]
        """
        bodies, movers, where = self._bodies, self._movers, self.where()
        self.forget(where == NOWHERE)
        self._felt[where == NOWHERE] = 0.0
        own = where == number
        raw = self._rigidly(movers.inverse_mass, movers.inverse_inertia(), impulses)
        yielding = self._rigidly(*mobility, impulses)
        self._felt[own] = lengths(raw[own, :3]) / dt
        awake = own & bodies.is_free & ~bodies.is_asleep
        self._change(np.where(awake[:, None], yielding - self._given, 0.0))
        self.forget(own)
        self._held[awake], self._yielding[awake] = raw[awake] / dt, yielding[awake] / dt

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """What is foreseen; none where there is no air."""
        return {name: array.copy() for name, array in self._state().items()} if self.boxes else {}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing or has another shape."""
        if not self.boxes:
            return
        for name, array in self._state().items():
            if name not in arrays or arrays[name].shape != array.shape:
                raise ValueError(f"checkpoint of the rigid bodies: {name} must have shape {array.shape}")
        self._held, self._yielding, self._felt = (np.array(arrays[name], np.float64) for name in self._state())
        self._given = np.zeros_like(self._held)

    def _state(self) -> dict[str, Array]:
        return {HELD: self._held, YIELDING: self._yielding, FELT: self._felt}

    @property
    def _movers(self) -> MovingBodies:
        return self._bodies if self._glue is None else self._glue.movers

    @property
    def _leader(self) -> NDArray[np.int64]:
        return np.arange(len(self._bodies)) if self._glue is None else self._glue.leader

    def _rigidly(self, inverse_mass: Array, inverse_inertia: Array, impulses: Array) -> Array:
        """Changes of the velocities of all bodies, (n, 6), by impulses on what they move with."""
        leader = self._leader
        change = inverse_mass[leader, None] * impulses[leader, :3]
        turn = np.einsum("nij,nj->ni", inverse_inertia, impulses[:, 3:])[leader]
        arms = self._bodies.position - self._movers.position[leader]
        return np.concatenate([change + rotation.cross(turn, arms), turn], axis=1)

    def _change(self, change: Array) -> None:
        bodies = self._bodies
        bodies.is_pushed = bodies.is_pushed | change.any(axis=1)
        bodies.velocity = bodies.velocity + change[:, :3]
        bodies.angular_velocity = bodies.angular_velocity + change[:, 3:]
        if self._glue is not None:
            self._glue.share()
