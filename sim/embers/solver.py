"""Embers of one fire, each a sphere in the air with a drag of its own."""

import math
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.drag import AIR_DENSITY, AIR_VISCOSITY, drag_coefficient
from sim.core.host_access import copied, put
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Diagnostics, Remedies
from sim.embers.parameters import COLD_K, LEAST_SHARE, MOST_SHARE, EmberParameters
from sim.shapes.placement import build_solid

if TYPE_CHECKING:
    from sim.shapes.placement import PlacedSolid

PLACES = 4096  # in each source, of which every ember takes one
DRAWS = 64  # of a source's box for each of them, before its shape counts as empty
STATE = ("position", "velocity", "age", "life", "diameter", "number")


@bundle
class Embers(NamedTuple):
    """Embers as kernels take them, one a place, (n,) each; places of embers that are cold are used again."""

    position: Vectors  # [m]
    velocity: Vectors  # [m/s]
    age: Floats  # negative before it comes [s]
    life: Floats  # age at which it is cold [s]
    diameter: Floats  # [m]
    number: Integers  # of the ember, from 0 on


class AirAround(Protocol):
    """The air that carries embers.

    Attributes:
        cell_size: scale over which it changes [m].
        low, high: ends of the room [m], (3,); far away where nothing ends it.
    """

    cell_size: float
    low: ti.math.vec3
    high: ti.math.vec3

    def find(self, position: ti.Ndarray, velocity: ti.Ndarray, is_stuck: ti.Ndarray) -> None:
        """Velocity of the air at positions now [m/s], (n, 3), and where something stops what flies, (n,)."""


class EmberSolver:
    """Embers that come at even intervals from random places of their sources, fly, fall, and grow cold.

        dv/dt = g - 3/4 rho_air/rho C_D(Re) |v - u| (v - u)/d

    with the air's velocity u, the law of the sphere for C_D, and rho_air of air at 20 degrees C. Drag is that at the
    end of a step, so that no step is too long for it. They fly through the air as it is at the end of each frame, do
    not slow it, and stay where something stops them.

    Attributes:
        parameters: of the embers.
        embers: for kernels.
        gravity: [m/s²]; may be changed between frames.

    Raises:
        ShapeError: a source cannot be built.
        ValueError: a source has no inside.
    """

    def __init__(
        self, parameters: EmberParameters, *, air: AirAround, gravity: Vector3, frames_per_second: float
    ) -> None:
        self.name, self.parameters, self.gravity = parameters.name, parameters, gravity
        self._frame_s = 1.0 / frames_per_second
        self._places = [
            _places_in(build_solid(source), np.random.default_rng((parameters.seed, index)))
            for index, source in enumerate(parameters.source)
        ]
        # Embers of a frame take their places when it begins, beside all that glow then.
        n = parameters.most + sum(math.ceil(source.rate * self._frame_s) + 1 for source in parameters.source)
        self.embers = Embers(
            *(ti.Vector.ndarray(3, ti.f32, n) for _ in range(2)),
            *(ti.ndarray(ti.f32, n) for _ in range(3)),
            on_device(np.full(n, -1, np.int32)),
        )
        self._air, self._wind, self._is_stuck = air, ti.Vector.ndarray(3, ti.f32, n), ti.ndarray(ti.i32, n)

    def stable_dt(self) -> float:
        """Step [s] in which no ember crosses more than a cell of the air."""
        self._air.find(self.embers.position, self._wind, self._is_stuck)
        flying = (age := copied(self.embers.age)) < copied(self.embers.life)
        flying &= (age > -self._frame_s) & (copied(self._is_stuck) == 0)
        speeds = [
            np.linalg.norm(copied(each)[flying], axis=1).max(initial=0.0) for each in (self.embers.velocity, self._wind)
        ]
        return self._air.cell_size / max(*map(float, speeds), self._air.cell_size / self._frame_s)

    def remedies(self) -> Remedies:
        """What may help where it fails."""
        return Remedies(
            runaway=f"look at smoke.{self.parameters.smoke}, whose air carries them",
            short_steps=f"look at smoke.{self.parameters.smoke}, whose air carries them",
        )

    def begin_frame(self, time_s: float) -> None:
        """Put the embers of the frame that starts at a time [s] into free places, each with the moment it comes."""
        first = self._came_until(time_s)
        arrays = {name: copied(getattr(self.embers, name)) for name in STATE}
        for index, source in enumerate(self.parameters.source):
            begin, end = time_s, min(time_s + self._frame_s, source.end_s or math.inf)
            low, high = (max(0, math.ceil(source.rate * (at - source.start_s) - 1e-6)) for at in (begin, end))
            if high <= low:
                continue
            chance = np.random.default_rng((self.parameters.seed, index, low))
            count = high - low
            numbers = first + np.arange(count)
            rows = numbers % len(arrays["number"])
            shares = chance.uniform(LEAST_SHARE, MOST_SHARE, (2, count))
            arrays["position"][rows] = chance.choice(self._places[index], count)
            arrays["velocity"][rows] = source.velocity + source.spread * chance.standard_normal((count, 3))
            arrays["age"][rows] = time_s - (source.start_s + np.arange(low, high) / source.rate)
            arrays["life"][rows] = self.parameters.lifetime * shares[0]
            arrays["diameter"][rows] = self.parameters.diameter * shares[1]
            arrays["number"][rows] = numbers
            first += count
        for name, values in arrays.items():
            put(getattr(self.embers, name), values)

    def _came_until(self, time_s: float) -> int:
        """How many embers have come before a time [s]."""
        return sum(
            max(0, math.ceil(source.rate * (min(time_s, source.end_s or math.inf) - source.start_s) - 1e-6))
            for source in self.parameters.source
        )

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._air.find(self.embers.position, self._wind, self._is_stuck)
        pull = 0.75 * AIR_DENSITY / self.parameters.density
        ends = self._air.low, self._air.high
        _fly(self.embers, self._wind, self._is_stuck, *ends, ti.math.vec3(self.gravity), pull, dt)

    def snapshots(self) -> dict[str, Snapshot]:
        """Embers that glow, in the order in which they came."""
        state = {name: copied(getattr(self.embers, name)) for name in STATE}
        rows = np.flatnonzero((state["age"] >= 0.0) & (state["age"] < state["life"]))
        rows = rows[np.argsort(state["number"][rows])]
        hot = self.parameters.temperature
        cooled = (hot - COLD_K) * (state["age"][rows] / state["life"][rows]) ** 2
        arrays = {
            "position": state["position"][rows],
            "velocity": state["velocity"][rows],
            "temperature": (hot - cooled).astype(np.float32),
            "diameter": state["diameter"][rows],
            "particle_id": state["number"][rows],
        }
        return {self.name: Snapshot("embers", arrays, {"radius": 0.5 * self.parameters.diameter})}

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """All arrays of the embers."""
        return {name: copied(getattr(self.embers, name)) for name in STATE}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when it does not fit."""
        for name in STATE:
            put(getattr(self.embers, name), np.asarray(arrays[name]))

    def diagnostics(self) -> Diagnostics:
        """How many glow, and the fastest of them."""
        age, life = copied(self.embers.age), copied(self.embers.life)
        glow = (age >= 0.0) & (age < life)
        speed = np.linalg.norm(copied(self.embers.velocity)[glow], axis=1)
        return {"particle_count": float(np.count_nonzero(glow)), "max_speed": float(speed.max(initial=0.0))}

    def first_bad_quantity(self) -> str | None:
        """The first quantity that is not finite, in words."""
        bad = np.count_nonzero(~np.isfinite(copied(self.embers.position)).all(axis=1))
        return f"{bad} embers have a position that is not finite" if bad else None


def _places_in(solid: "PlacedSolid", chance: np.random.Generator) -> NDArray[np.float64]:
    """Random places in a solid [m], (PLACES, 3)."""
    low, high = solid.bounds
    found, drawn = np.empty((0, 3)), 0
    while len(found) < PLACES and drawn < DRAWS:
        points = chance.uniform(low, high, (PLACES, 3))
        found, drawn = np.concatenate([found, points[solid.signed_distance(points) < 0.0]]), drawn + 1
    if len(found) < PLACES:
        raise ValueError("a source of embers has hardly any inside")
    return found[:PLACES]


@kernel
def _fly(
    embers: Embers,
    air: Vectors,
    is_stuck: Integers,
    low: ti.math.vec3,
    high: ti.math.vec3,
    gravity: ti.math.vec3,
    pull: ti.f32,
    dt: ti.f32,
):
    for i in range(embers.age.shape[0]):
        step = ti.min(dt, embers.age[i] + dt)  # those that come within the step fly for the rest of it
        if embers.number[i] >= 0 and step > 0.0 and embers.age[i] < embers.life[i]:
            if is_stuck[i]:
                embers.velocity[i] = ti.math.vec3(0.0)
            else:
                speed = (embers.velocity[i] - air[i]).norm()
                reynolds = AIR_DENSITY * speed * embers.diameter[i] / AIR_VISCOSITY
                rate = pull * drag_coefficient(reynolds) * speed / embers.diameter[i]
                gained = embers.velocity[i] + step * (gravity + rate * air[i])
                embers.velocity[i] = gained / (1.0 + step * rate)
                there = embers.position[i] + step * embers.velocity[i]
                embers.position[i] = ti.min(ti.max(there, low), high)
                if (there < low).any() or (there > high).any():
                    embers.velocity[i] = ti.math.vec3(0.0)
        embers.age[i] += dt
