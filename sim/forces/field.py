"""All forces of a job as kernels see them: accelerations, drag and moving air, at a place and a moment."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, on_device
from sim.core.bundles import bundle, func
from sim.core.hashed_numbers import hash_to_smooth, spread
from sim.core.motion import rotation
from sim.forces.parameters import (
    AirForce,
    AttractorForce,
    BaseForce,
    DragForce,
    GravityForce,
    RegionParameters,
    TurbulenceForce,
    VortexForce,
    WindForce,
)
from sim.shapes.parameters import BoxShape, SphereShape

GRAVITY, ATTRACTOR, DRAG, WIND, VORTEX, TURBULENCE = range(6)
EVERYWHERE, BOX, SPHERE, CYLINDER = range(4)

# Columns of a force's row of numbers.
KIND, POSITION, DIRECTION, VECTOR, VALUE, RADIUS, FALLOFF, RESPONSE, GUSTS, GUST_S = 0, 1, 4, 7, 10, 11, 12, 13, 14, 15
REGION, CENTRE, HALVES, EDGE, TURN, WIDTH = 16, 17, 20, 23, 24, 33

MODES = 24
"""Fourier modes of a turbulence: enough for each to have a small part, few enough for every particle to sum them."""
SMALLEST_EDDY = 1.0 / 6.0
"""Size of the smallest eddies over that of the largest [-]."""
MODE_WIDTH = 10  # numbers of a mode: its wave vector [1/m], two vectors [m/s], its frequency [1/s]
PEAK = 3.0  # largest speed of turbulence that steps are cut for, over the root mean square: exceeded by chance only

Float64Array = NDArray[np.float64]


@bundle
class ForceTable(NamedTuple):
    """The forces of a job at one moment, and on which of a solver's bodies they act."""

    count: ti.i32
    numbers: Floats  # `WIDTH` of each
    modes: Floats  # of turbulence: `MODES` times `MODE_WIDTH` of each force
    salts: Integers  # of their random numbers, (count,)
    strengths: Floats  # at the moment [-], (count,)
    acts: Integers  # whether each acts on each body, (bodies * count,)
    time_s: ti.f32


class ForceField:
    """The forces of a job; `at` takes them to a moment, `on` to the bodies of a solver.

    Attributes:
        parameters: the forces.
        strengths: of them at the moment [-].
    """

    def __init__(self, parameters: Sequence[BaseForce]) -> None:
        self.parameters = tuple(parameters)
        numbers = np.zeros((len(self.parameters), WIDTH))
        modes = np.zeros((len(self.parameters), MODES, MODE_WIDTH))
        for row, own, force in zip(numbers, modes, self.parameters, strict=True):
            _describe(force, row)
            if isinstance(force, TurbulenceForce):
                own[:] = modes_of(force)
        salts = [spread(getattr(force, "seed", 0)) for force in self.parameters]
        self._numbers, self._modes = on_device(numbers.ravel()), on_device(modes.ravel())
        self._salts = on_device(np.array(salts, dtype=np.uint32).view(np.int32))
        self._strengths, self._time_s = on_device(np.zeros(len(self.parameters))), 0.0
        self.strengths: tuple[float, ...] = ()
        self.at(0.0)

    def at(self, time_s: float) -> None:
        """Take all forces to a simulated time [s]."""
        self._time_s = time_s
        strengths = tuple(force.strength(time_s) for force in self.parameters)
        if strengths and strengths != self.strengths:
            self._strengths.from_numpy(np.array(strengths, dtype=np.float32))
        self.strengths = strengths

    def on(self, names: Sequence[tuple[str, ...]]) -> "ForcesOn":
        """The forces on the bodies of a solver, each of which has one or more names: its own, and its group's."""
        return ForcesOn(self, names)

    def now(self, acts: ti.Ndarray) -> ForceTable:
        """The bundle for kernels, for bodies that these act on."""
        return ForceTable(
            len(self.parameters), self._numbers, self._modes, self._salts, self._strengths, acts, self._time_s
        )


class ForcesOn:
    """The forces on the bodies of one solver.

    Attributes:
        accelerates, blows: whether any of them accelerates or slows these bodies; whether any moves the air about them.
        largest_acceleration, largest_wind: bounds at all times, of one that is met by all at once [m/s²], [m/s].
        fastest_response: of smoke's air [1/s]; 0 without wind.
    """

    def __init__(self, field: ForceField, names: Sequence[tuple[str, ...]]) -> None:
        self._field = field
        meets = [[not force.only or bool(set(force.only) & set(own)) for force in field.parameters] for own in names]
        acts = np.array(meets, dtype=np.int32).reshape(len(names), len(field.parameters))
        self._acts = on_device(acts.ravel())
        self._acts_on_any = acts.any(axis=0)
        own = [force for force, meant in zip(field.parameters, self._acts_on_any, strict=True) if meant]
        winds = [force for force in own if isinstance(force, AirForce)]
        self.accelerates, self.blows = len(winds) < len(own), bool(winds)
        self.largest_acceleration = sum(map(_largest_acceleration, own))
        self.largest_wind = sum(map(_largest_wind, winds))
        self.fastest_response = max((1.0 / wind.response_s for wind in winds), default=0.0)

    @property
    def now(self) -> ForceTable:
        """The bundle for kernels, at the present moment."""
        return self._field.now(self._acts)

    def even_wind(self) -> tuple[Float64Array, float]:
        """Mean velocity of the winds that blow everywhere, (3,) [m/s], and the rate at which smoke's air takes it on.

        At the present moment; gusts and what is limited to a shape are left out.
        """
        velocity, response = np.zeros(3), 0.0
        for wind, strength in self._even_winds():
            velocity += strength * np.asarray(wind.velocity)
            response = max(response, strength / wind.response_s)
        return velocity, response

    def _even_winds(self) -> Iterator[tuple[WindForce, float]]:
        own = zip(self._field.parameters, self._field.strengths, self._acts_on_any, strict=True)
        return (
            (force, strength)
            for force, strength, acts in own
            if acts and isinstance(force, WindForce) and force.within is None
        )


@func
def acceleration_at(forces: ForceTable, body: ti.i32, x: ti.math.vec3, gravity: ti.template()) -> ti.math.vec3:
    """Sum of the accelerations of attractors at a place, or of gravity, on a body [m/s²]."""
    total = ti.math.vec3(0.0)
    for f in range(forces.count):
        row = f * WIDTH
        kind = ti.cast(forces.numbers[row + KIND], ti.i32)
        if forces.acts[body * forces.count + f] == 1 and kind == ti.static(GRAVITY if gravity else ATTRACTOR):
            share = forces.strengths[f] * share_within(forces, row, x)
            if ti.static(gravity):
                total += share * _vector(forces, row + VECTOR)
            else:
                away = x - _vector(forces, row + POSITION)
                direction = _vector(forces, row + DIRECTION)
                away -= away.dot(direction) * direction
                radius = forces.numbers[row + RADIUS]
                r = away.norm()
                part = r / radius  # of the force, and of the distance
                if part > 1.0:
                    part = part ** -forces.numbers[row + FALLOFF]
                total -= share * forces.numbers[row + VALUE] * part / ti.max(r, 1.0e-12) * away
    return total


@func
def drag_at(forces: ForceTable, body: ti.i32, x: ti.math.vec3) -> ti.f32:
    """Rate at which a body loses its velocity at a place [1/s]."""
    rate = 0.0
    for f in range(forces.count):
        row = f * WIDTH
        is_drag = ti.cast(forces.numbers[row + KIND], ti.i32) == DRAG
        if forces.acts[body * forces.count + f] == 1 and is_drag:
            rate += forces.strengths[f] * share_within(forces, row, x) * forces.numbers[row + VALUE]
    return rate


@func
def change_of_velocity(forces: ForceTable, body: ti.i32, x: ti.math.vec3, v: ti.math.vec3, dt: ti.f32) -> ti.math.vec3:
    """By accelerations and drag in dt [s], of what is at x with a velocity v [m/s]."""
    change = dt * (acceleration_at(forces, body, x, True) + acceleration_at(forces, body, x, False))
    return change - kept_off(drag_at(forces, body, x) * dt) * v


@func
def kept_off(exponent: ti.f32) -> ti.f32:
    """1 - exp(-e), what a decay takes [-]."""
    return 1.0 - ti.exp(-exponent)


@func
def air_at(forces: ForceTable, body: ti.i32, x: ti.math.vec3) -> ti.math.vec4:
    """Velocity that winds give the air about a body at a place [m/s], and the rate at which smoke takes it on [1/s]."""
    total = ti.math.vec3(0.0)
    response = 0.0
    for f in range(forces.count):
        row = f * WIDTH
        kind = ti.cast(forces.numbers[row + KIND], ti.i32)
        if forces.acts[body * forces.count + f] == 1 and kind >= WIND:
            share = forces.strengths[f] * share_within(forces, row, x)
            if share > 0.0:
                response = ti.max(response, share * forces.numbers[row + RESPONSE])
                wind = ti.math.vec3(0.0)
                if kind == WIND:
                    wind = gusty(forces, f, x)
                elif kind == VORTEX:
                    direction = _vector(forces, row + DIRECTION)
                    around = direction.cross(x - _vector(forces, row + POSITION))
                    radius = forces.numbers[row + RADIUS]
                    beyond = ti.max(around.norm() / radius, 1.0)
                    wind = forces.numbers[row + VALUE] / (radius * beyond * beyond) * around
                else:
                    wind = forces.numbers[row + VALUE] * eddies(forces, f, x)
                total += share * wind
    return ti.math.vec4(total.x, total.y, total.z, response)


@func
def gusty(forces: ForceTable, f: ti.i32, x: ti.math.vec3) -> ti.math.vec3:
    """An even wind, whose gusts it carries along (Taylor 1938: turbulence as if frozen)."""
    row = f * WIDTH
    wind = _vector(forces, row + VECTOR)
    if forces.numbers[row + GUSTS] > 0.0:
        late = x.dot(wind) / ti.max(wind.norm_sqr(), 1.0e-12)
        gust = hash_to_smooth((forces.time_s - late) / forces.numbers[row + GUST_S], forces.salts[f])
        wind *= 1.0 + forces.numbers[row + GUSTS] * (2.0 * gust - 1.0)
    return wind


@func
def eddies(forces: ForceTable, f: ti.i32, x: ti.math.vec3) -> ti.math.vec3:
    """sum_n a_n cos(k_n.x + w_n t) + b_n sin(k_n.x + w_n t), a_n and b_n across k_n: of no divergence; rms 1."""
    total = ti.math.vec3(0.0)
    for n in range(MODES):
        mode = (f * MODES + n) * MODE_WIDTH
        wave = ti.math.vec3(forces.modes[mode], forces.modes[mode + 1], forces.modes[mode + 2])
        phase = wave.dot(x) + forces.modes[mode + 9] * forces.time_s
        c, s = ti.cos(phase), ti.sin(phase)
        for axis in ti.static(range(3)):
            total[axis] += c * forces.modes[mode + 3 + axis] + s * forces.modes[mode + 6 + axis]
    return total


@func
def share_within(forces: ForceTable, row: ti.i32, x: ti.math.vec3) -> ti.f32:
    """How much of a force acts at a place, by its region: 0 outside, 1 from its edge inwards."""
    region = ti.cast(forces.numbers[row + REGION], ti.i32)
    depth = 1.0e30
    if region != EVERYWHERE:
        away = x - _vector(forces, row + CENTRE)
        p = ti.math.vec3(0.0)
        for axis in ti.static(range(3)):
            p[axis] = _vector(forces, row + TURN + 3 * axis).dot(away)
        half = _vector(forces, row + HALVES)
        if region == BOX:
            inside = half - ti.abs(p)
            depth = ti.min(ti.min(inside.x, inside.y), inside.z)
        elif region == SPHERE:
            depth = half.x - p.norm()
        else:
            depth = ti.min(half.x - ti.sqrt(p.x * p.x + p.y * p.y), half.z - ti.abs(p.z))
    return ti.math.clamp(depth / ti.max(forces.numbers[row + EDGE], 1.0e-12), 0.0, 1.0)


@func
def _vector(forces: ForceTable, first: ti.i32) -> ti.math.vec3:
    return ti.math.vec3(forces.numbers[first], forces.numbers[first + 1], forces.numbers[first + 2])


def modes_of(force: TurbulenceForce) -> Float64Array:
    """Fourier modes of a turbulence whose mean square is 1, (MODES, MODE_WIDTH); see `eddies`.

    Wave numbers are even in their logarithm, with the energy of Kolmogorov's spectrum, k^(-5/3) dk, and frequencies
    that grow with k^(2/3), as eddies turn.
    """
    random = np.random.Generator(np.random.Philox(key=force.seed))
    ratios = SMALLEST_EDDY ** -((np.arange(MODES) + random.random(MODES)) / MODES)
    wave = _directions(random) * (ratios * 2.0 * math.pi / force.size)[:, None]
    across = [np.cross(_directions(random), wave) for _ in range(2)]
    across = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in across]
    energy = ratios ** (-2.0 / 3.0)
    amplitude = np.sqrt(energy / energy.sum())[:, None]
    frequency = 2.0 * math.pi * force.rate * ratios ** (2.0 / 3.0) * random.standard_normal(MODES)
    return np.concatenate([wave, *(amplitude * each for each in across), frequency[:, None]], axis=1)


def _directions(random: np.random.Generator) -> Float64Array:
    """As many unit vectors as there are modes, in all directions alike."""
    vectors = random.standard_normal((MODES, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _unit(vector: Sequence[float]) -> Float64Array:
    return np.asarray(vector) / np.linalg.norm(vector)


def _describe(force: BaseForce, row: Float64Array) -> None:
    """Write what kernels need of a force into its row."""
    if isinstance(force, GravityForce):
        row[KIND], row[VECTOR : VECTOR + 3] = GRAVITY, force.acceleration
    elif isinstance(force, AttractorForce):
        row[KIND], row[POSITION : POSITION + 3] = ATTRACTOR, force.position
        row[VALUE], row[RADIUS], row[FALLOFF] = force.acceleration, force.radius, force.falloff
        if force.direction is not None:
            row[DIRECTION : DIRECTION + 3] = _unit(force.direction)
    elif isinstance(force, DragForce):
        row[KIND], row[VALUE] = DRAG, force.rate
    elif isinstance(force, WindForce):
        row[KIND], row[VECTOR : VECTOR + 3] = WIND, force.velocity
        row[GUSTS], row[GUST_S] = force.gusts, force.gust_s
    elif isinstance(force, VortexForce):
        row[KIND], row[VALUE], row[RADIUS] = VORTEX, force.speed, force.radius
        row[POSITION : POSITION + 3], row[DIRECTION : DIRECTION + 3] = force.position, _unit(force.direction)
    elif isinstance(force, TurbulenceForce):
        row[KIND], row[VALUE] = TURBULENCE, force.speed
    if isinstance(force, AirForce):
        row[RESPONSE] = 1.0 / force.response_s
    if force.within is not None:
        _describe_region(force.within, row)


def _describe_region(region: RegionParameters, row: Float64Array) -> None:
    shape = region.shape
    if isinstance(shape, BoxShape):
        row[REGION], row[HALVES : HALVES + 3] = BOX, 0.5 * np.array(shape.size)
    elif isinstance(shape, SphereShape):
        row[REGION], row[HALVES] = SPHERE, shape.radius
    else:
        row[REGION], row[HALVES], row[HALVES + 2] = CYLINDER, shape.radius, 0.5 * shape.height
    row[CENTRE : CENTRE + 3], row[EDGE] = region.position, region.edge
    row[TURN : TURN + 9] = rotation.matrices(rotation.from_degrees(region.rotation_deg)).T.ravel()


def _largest_acceleration(force: BaseForce) -> float:
    if isinstance(force, GravityForce):
        return math.hypot(*force.acceleration)
    return abs(force.acceleration) if isinstance(force, AttractorForce) else 0.0


def _largest_wind(force: AirForce) -> float:
    if isinstance(force, WindForce):
        return math.hypot(*force.velocity) * (1.0 + force.gusts)
    if isinstance(force, VortexForce):
        return abs(force.speed)
    return PEAK * force.speed if isinstance(force, TurbulenceForce) else 0.0
