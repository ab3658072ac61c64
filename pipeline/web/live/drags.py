"""Drags: constraints by which mice lead bodies, pins and cloth, smoothly and never faster than contacts can follow."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.rigid import is_animated
from pipeline.model.job import Job
from pipeline.web.pins import JobPin, pins_of_job
from sim.core.world import World

Vector = NDArray[np.float64]
Point = tuple[float, float, float]

FOLLOWING_RATE = 15.0
"""Rate of the spring to the mouse [1/s]: critically damped, most of the distance in 0.2 s."""
LARGEST_SPEED = 3.0
"""Nothing is led faster [m/s]: a body gets 2.5 mm on in a substep of cloth then, and a mouse jumps at will."""
SPIN_DECAY = 6.0
"""A held body stops turning at this rate [1/s]."""
AT_REST = 1.0e-6
"""Closer to the mouse than this [m], nodes are left where they are."""
GRABBED_SPACINGS = 1.5
"""Cloth is grabbed by the nodes within this many spacings: a single node would be drawn into a spike."""


def towards(target: Vector, position: Vector, velocity: Vector, dt: float) -> Vector:
    """Velocity [m/s] of the next dt [s] on a critically damped spring to a target, (3,), integrated implicitly."""
    rate = FOLLOWING_RATE * dt
    wanted: Vector = (velocity + rate * FOLLOWING_RATE * (target - position)) / (1.0 + rate) ** 2
    speed = float(np.linalg.norm(wanted))
    return wanted * min(1.0, LARGEST_SPEED / speed) if speed > 0.0 else wanted


class BodySpring:
    """A spring on a dynamic body: whatever it hits pushes back, and when it is released it flies on."""

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


class BodyPath:
    """A path of a kinematic body, which moves whatever it hits; when it is released it stays."""

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


class NodePath:
    """A path of nodes of a cloth, (k,), led as one; when they are released they fly on, unless they are a pin's."""

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
        """Let them fly on with their velocity, or stay pinned."""
        if self._stays:
            self._cloth.hold(self._name, self.nodes.tolist())
        else:
            self._cloth.let_go(self._name, self.nodes.tolist())


Constraint = BodySpring | BodyPath | NodePath
"""What leads something towards its `target` [m], (3,)."""


class Handle(NamedTuple):
    """Something that a browser holds: a body, a pin by its number, or a place of a cloth, one for each browser."""

    kind: str
    name: str
    holder: int


class Drags:
    """All that browsers hold in a scene."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self.unbind()

    def unbind(self) -> None:
        """Forget the world and all that is held in it."""
        self._world: World | None = None
        self._solvers: Mapping[str, Any] = {}
        self._pins: list[JobPin] = []
        self._led_pins: set[int] = set()
        self.held: dict[Handle, Constraint] = {}

    def bind(self, world: World) -> None:
        """Hold things in another world from now on, nothing yet."""
        self.unbind()
        self._world, self._solvers = world, world.solvers
        self._pins = pins_of_job(self._job)

    @property
    def pins(self) -> dict[int, tuple[str, NDArray[np.int64]]]:
        """Cloth and nodes, in its own numbers, of every pin that holds now, by the pin's number."""
        assert self._world is not None
        return {
            number: (pin.cloth, pin.nodes)
            for number, pin in enumerate(self._pins)
            if number in self._led_pins or pin.holds(self._world.time_s)
        }

    @property
    def names(self) -> list[str]:
        """Everything that is held, as messages call it."""
        return list(dict.fromkeys(f"pin {name}" if kind == "pin" else f'"{name}"' for kind, name, _ in self.held))

    def grab(self, kind: str, name: str, point: Point = (0.0, 0.0, 0.0), holder: int = 0) -> None:
        """Take something in hand at a point of the world [m]; a cloth at its node nearest to that, or that node's pin.

        Raises ValueError: there is no such thing that moves, or another browser holds it.
        """
        if kind not in GRABS:
            raise ValueError(f'"{name}" cannot be moved')
        GRABS[kind](self, name, point, holder)

    def move(self, kind: str, name: str, target: Point, holder: int = 0) -> None:
        """Lead a browser's thing to a place [m]; nothing if it holds it no more."""
        place = np.asarray(target, dtype=np.float64)
        if np.isfinite(place).all():
            for handle in self._of(holder, kind, name):
                self.held[handle].target = place

    def release(self, kind: str, name: str, holder: int = 0) -> None:
        """Release a browser's thing."""
        for handle in self._of(holder, kind, name):
            self._end(handle)

    def release_all(self, holder: int | None = None) -> None:
        """Release all that a browser holds, such as one that is gone; everything if omitted."""
        for handle in list(self.held):
            if holder is None or handle.holder == holder:
                self._end(handle)

    def advance(self, dt: float) -> None:
        """Lead everything on for a frame of dt [s]."""
        for constraint in self.held.values():
            constraint.move(dt)
        if self.held and self._world is not None:
            self._world.tell_couplings()

    def _grab_body(self, name: str, point: Point, holder: int) -> None:
        rigid = self._solvers.get("rigid")
        if rigid is None or name not in rigid.bodies.names:
            raise ValueError(f'"{name}" cannot be moved')
        number = rigid.bodies.names.index(name)
        at = np.asarray(point, dtype=np.float64)
        handle = self._freed(Handle("rigid", name, holder), called=f'"{name}"')
        if rigid.bodies.is_dynamic[number]:
            self.held[handle] = BodySpring(rigid, number, arm=at - rigid.bodies.position[number])
        else:
            self.held[handle] = BodyPath(rigid, number, arm=at - rigid.paths[number].at(rigid.time_s).position)

    def _grab_cloth(self, name: str, point: Point, holder: int) -> None:
        cloth = self._solvers["cloth"]
        number = cloth.state.names.index(name)
        first, last = cloth.state.host.first_node[number : number + 2]
        position = cloth.state.positions()[first:last]
        nearest = int(np.argmin(np.linalg.norm(position - np.asarray(point), axis=1)))
        pins = {number: nodes for number, (of_cloth, nodes) in self.pins.items() if of_cloth == name}
        for number, nodes in pins.items():
            if nearest in nodes:
                self._grab_pin(str(number), point, holder)
                return
        handle = Handle("cloth", name, holder)
        theirs = [
            constraint.nodes
            for other, constraint in self.held.items()
            if isinstance(constraint, NodePath) and other[:2] == handle[:2] and other.holder != holder
        ]
        if any(nearest in nodes for nodes in theirs):
            raise ValueError(f'another browser holds "{name}" there')
        area = cloth.state.host.node_area[first + nearest]
        around = np.linalg.norm(position - position[nearest], axis=1) <= GRABBED_SPACINGS * np.sqrt(area)
        free = np.setdiff1d(np.flatnonzero(around), np.concatenate([np.empty(0, np.int64), *pins.values(), *theirs]))
        self._end(handle)
        self.held[handle] = NodePath(cloth, name, free, stays=False)

    def _grab_pin(self, name: str, _point: Point, holder: int) -> None:
        """Take a pin's nodes in hand: its keyframes and its release do not apply to them any more."""
        number = int(name)
        if not 0 <= number < len(self._pins):
            raise ValueError(f"there is no pin {number}")
        if number not in self.pins:
            raise ValueError(f"pin {number} has been released")
        cloth, nodes = self.pins[number]
        handle = self._freed(Handle("pin", str(number), holder), called=f'pin {number} of "{cloth}"')
        self.held[handle] = NodePath(self._solvers["cloth"], cloth, nodes, stays=True)
        self._led_pins.add(number)

    def _of(self, holder: int, kind: str, name: str) -> list[Handle]:
        """Handles that a browser means by a thing: of a cloth, it may be a pin that its mouse got hold of."""
        handle = Handle(kind, name, holder)
        if handle in self.held:
            return [handle]
        mine = [held for held in self.held if held.holder == holder and held.kind == "pin"]
        return [held for held in mine if self._pins[int(held.name)].cloth == name] if kind == "cloth" else []

    def _freed(self, handle: Handle, *, called: str) -> Handle:
        """The handle of a thing that only one browser can hold, after its own constraint has ended.

        Raises ValueError: another browser holds it.
        """
        if any(held[:2] == handle[:2] and held.holder != handle.holder for held in self.held):
            raise ValueError(f"another browser holds {called}")
        self._end(handle)
        return handle

    def _end(self, handle: Handle) -> None:
        if isinstance(constraint := self.held.pop(handle, None), NodePath):  # a body flies on, or stays, by itself
            constraint.release()


GRABS: Mapping[str, Callable[[Drags, str, Point, int], None]] = {
    "rigid": Drags._grab_body,
    "cloth": Drags._grab_cloth,
    "pin": Drags._grab_pin,
}
"""Ways to grab things by kind, pins among them; other kinds cannot be dragged."""


def is_draggable(job: Job, kind: str, name: str) -> bool:
    """Whether a mouse may lead a thing of a scene."""
    if kind == "rigid" and any(is_animated(body) for body in job.rigid if body.name == name):
        return False
    return kind in GRABS and (kind != "rigid" or name in job.moving_bodies)
