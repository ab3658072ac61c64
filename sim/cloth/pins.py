"""What holds nodes of a cloth: which nodes, along which path, and until when."""

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters, PinParameters
from sim.cloth.sheet import RestSheet
from sim.cloth.start import path_of_pin, pinned_nodes
from sim.cloth.state import ClothState, move_pinned
from sim.core.arrays import on_device
from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath
from sim.core.parameters import Vector3

Floats = NDArray[np.float64]

ROUND_OFF_S = 1.0e-9  # times that differ by less [s] are the same: sums of steps


def holds(release_s: float, time_s: float) -> bool:
    """Whether a pin that lets go at a time [s] holds its nodes at another [s]."""
    return bool(time_s < release_s - ROUND_OFF_S)


class Pin:
    """One pin of one cloth.

    Attributes:
        nodes: that it holds, in the numbers of the scene, (p,).
        release_s: when it lets go [s]; infinite if never.
        path: where it is, None if it never moves.
    """

    def __init__(self, parameters: PinParameters, nodes: NDArray[np.int64], position: Floats) -> None:
        self.nodes = nodes
        self.release_s = np.inf if parameters.release_s is None else parameters.release_s
        self.path: KeyframePath | None = None
        if not parameters.keyframe:
            return
        self.path = path_of_pin(parameters)
        self._take(nodes, position[nodes] - position[nodes].mean(axis=0))

    def _take(self, nodes: NDArray[np.int64], arm: Floats) -> None:
        """Hold nodes that have these places about the centre [m], (p, 3)."""
        self.nodes, self._host_arm = nodes, arm
        self._nodes, self._arm = on_device(nodes), on_device(arm)

    def drop(self, nodes: NDArray[np.int64]) -> bool:
        """Hold these nodes no longer; returns whether any others are left."""
        kept = ~np.isin(self.nodes, nodes)
        if kept.all() or not kept.any():
            return bool(kept.all())
        if self.path is None:
            self.nodes = self.nodes[kept]
        else:
            self._take(self.nodes[kept], self._host_arm[kept])
        return True

    def displace(self, state: ClothState, time_s: float, dt: float) -> None:
        """Move its nodes from where they are at a time [s] to where they will be dt later."""
        if self.path is None:
            return
        before, after = self.path.at(time_s), self.path.at(time_s + dt)
        shift = after.position - before.position
        turn = rotation.matrices(after.orientation[None])[0] - rotation.matrices(before.orientation[None])[0]
        if shift.any() or turn.any():
            move_pinned(
                self._nodes, self._arm, state.carry, *(ti.math.vec3(*row) for row in (shift, *turn)), state.displacement
            )


class Pins:
    """All pins of a scene's cloths; a node of several is free when all have let go."""

    def __init__(self, cloths: Sequence[ClothParameters], sheets: Sequence[RestSheet], state: ClothState) -> None:
        """Find the nodes.

        Raises:
            ValueError: a pin holds nothing, or one that moves shares a node with another.
        """
        self._state = state
        self._pins: list[Pin] = []
        self._grips: list[Pin] = []  # those of them that no job has
        self._held: tuple[bool, ...] | None = None
        position = state.host.position
        for number, (cloth, sheet) in enumerate(zip(cloths, sheets, strict=True)):
            first, last = state.host.first_node[number : number + 2]
            for index, parameters in enumerate(cloth.pin):
                place = f'cloth "{cloth.name}": pin[{index}]'
                try:
                    nodes = pinned_nodes(parameters, sheet, position[first:last]) + first
                except ValueError as error:
                    raise ValueError(f"{place}: {error}") from error
                pin = Pin(parameters, nodes, position)
                for other in self._pins:
                    shared = np.intersect1d(nodes, other.nodes)
                    if len(shared) and (pin.path is not None or other.path is not None):
                        raise ValueError(
                            f"{place} shares node {shared[0] - first} with another pin, and one of them moves; "
                            "pin each node once"
                        )
                self._pins.append(pin)

    def hold(self, time_s: float) -> bool:
        """Hold what is pinned at a simulated time [s]; returns whether that differs from before."""
        held = tuple(holds(pin.release_s, time_s) for pin in self._pins)
        if held == self._held:
            return False
        self._held = held
        self.hold_anew()
        return True

    def hold_anew(self) -> None:
        """Hold the same nodes as before, after their masses changed."""
        is_pinned = np.zeros(self._state.vertex_count, dtype=bool)
        for pin, is_held in zip(self._pins, self._held or (), strict=True):
            if is_held:
                is_pinned[pin.nodes] = True
        self._state.set_pinned(is_pinned)

    def grip(self, nodes: NDArray[np.int64], shift: Vector3, *, time_s: float, within_s: float) -> None:
        """Hold more nodes from a time [s] on, and lead them by a way [m] in so many seconds; `hold` does the rest.

        Nodes that a pin leads along its own path leave that for good.

        Raises:
            ValueError: the way is not finite, or takes no time.
        """
        if not (np.isfinite(shift).all() and 0.0 < within_s < np.inf):
            raise ValueError(f"a finite way in more than 0 s is needed, got {tuple(shift)} m within {within_s:g} s")
        # Those that were gripped before are led on from where they are; one leader is enough for a node.
        self._pins = [pin for pin in self._pins if (pin.path is None and pin not in self._grips) or pin.drop(nodes)]
        keys: dict[str, object] = {"index": nodes.tolist()}
        if any(shift):
            keys["keyframe"] = [{"time_s": time_s}, {"time_s": time_s + within_s, "offset": shift}]
            keys["interpolation"] = "linear"
        parameters = PinParameters.model_validate(keys)
        grip = Pin(parameters, nodes, self._state.positions())
        self._grips = [*(pin for pin in self._grips if pin in self._pins), grip]
        self._pins.append(grip)
        self._held = None

    def let_go(self, nodes: NDArray[np.int64]) -> None:
        """Let nodes go, whatever holds them; `hold` does the rest."""
        self._pins = [pin for pin in self._pins if pin.drop(nodes)]
        self._held = None

    def displace(self, time_s: float, dt: float) -> None:
        """Move the nodes of pins that hold, from a time [s] on, for dt."""
        for pin, is_held in zip(self._pins, self._held or (), strict=True):
            if is_held:
                pin.displace(self._state, time_s, dt)
