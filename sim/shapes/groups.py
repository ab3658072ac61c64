"""Groups: many bodies or blocks of one table, in rows and layers, along a curve, or scattered in a shape.

A job has the same ones on every machine: random numbers come from bits of a generator whose stream is fixed, places
are computed by what IEEE 754 rounds in one way, and rounded where a sine or a turn went in.
"""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.parameters import KeyRefusedError, Vector3
from sim.shapes.extent import ball_around, box_around, depth_inside
from sim.shapes.group_parameters import CurveParameters, GroupedPlacement, ScatterParameters

SIZES = 8
"""How many sizes those of a group have at most: bodies of one size share mesh and distances."""
MOST_TRIES = 2000
"""Places that are tried for one before a shape counts as full."""
PARTS_OF_CURVE = 200  # straight pieces of a curve between two of its points

_PLACE_DIGITS, _TURN_DIGITS = 9, 6  # decimals of what is computed [m] and [degrees]

Array = NDArray[np.float64]


class Placing(TypedDict):
    """Where one of a group is."""

    member: int  # which it is, from 1
    position: Vector3  # [m]
    rotation_deg: Vector3
    scale: float


@dataclass(frozen=True)
class Chance:
    """Random numbers of a group: each purpose has its own, so that one changes nothing for the others."""

    name: str
    seed: int

    def stream(self, what: str) -> np.random.PCG64:
        """The bits of a purpose."""
        digest = hashlib.blake2b(f"{self.name} {self.seed} {what}".encode(), digest_size=16).digest()
        return np.random.PCG64(int.from_bytes(digest, "big"))

    def uniform(self, what: str, shape: tuple[int, ...]) -> Array:
        """Numbers of a purpose from 0 to 1, without that."""
        return _chances(self.stream(what), math.prod(shape)).reshape(shape)


def members(table: GroupedPlacement, number: int, name: str, scattered: Taken) -> Iterator[Placing]:
    """Where those of a group are, whose table is of a number in its list; chance goes by a name.

    Raises:
        KeyRefusedError: they have no room.
    """
    chance, count = Chance(name, table.seed), table.many
    scales = _scales(table, count, chance)
    places, yaws = _places(table, number, scales, scattered, chance)
    turned = rotation.from_degrees(table.rotation_deg)
    if any(table.rotation_deg):
        places = np.round(rotation.rotated(turned, places), _PLACE_DIGITS)
    places = places + np.array(table.position)
    turns = _turns(table, yaws, turned, count, chance)
    if table.jitter is not None:
        reach = np.array(table.jitter.position)
        places = places + reach * (2.0 * chance.uniform("jitter of places", (count, 3)) - 1.0)
    for index in range(count):
        x, y, z = (float(value) for value in np.round(places[index], _PLACE_DIGITS))
        yield Placing(member=index + 1, position=(x, y, z), rotation_deg=turns[index], scale=scales[index])


def _scales(table: GroupedPlacement, count: int, chance: Chance) -> list[float]:
    """The scale of each: evenly spread over the sizes, whose logarithms are."""
    if table.scales is None:
        return [table.scale] * count
    low, high = table.scales
    sizes = [float(f"{table.scale * low * (high / low) ** (step / (SIZES - 1)):.6g}") for step in range(SIZES)]
    return [sizes[int(SIZES * each)] for each in chance.uniform("sizes", (count,))]


def _turns(table: GroupedPlacement, yaws: Array | None, turned: Array, count: int, chance: Chance) -> list[Vector3]:
    """Rotation of each about x, then y, then z [degrees]."""
    own = [] if yaws is None else [rotation.from_degrees(yaws[:, None] * np.array([0.0, 0.0, 1.0]))]
    if table.scatter is not None and table.scatter.turned:
        own.append(_any_turns(chance.uniform("turns", (count, 3))))
    if table.jitter is not None and any(table.jitter.rotation_deg):
        reach = np.array(table.jitter.rotation_deg)
        own.append(rotation.from_degrees(reach * (2.0 * chance.uniform("jitter of turns", (count, 3)) - 1.0)))
    if not own:
        return [table.rotation_deg] * count
    whole = np.tile(turned, (count, 1))
    for each in own:
        whole = rotation.product(whole, each)
    found = np.round(rotation.to_degrees(whole), _TURN_DIGITS) + 0.0
    return [(float(x), float(y), float(z)) for x, y, z in found]


def _any_turns(chances: Array) -> Array:
    """Unit quaternions of which none is likelier than another, of numbers from 0 to 1, (n, 3).

    Shoemake 1992, "Uniform random rotations".
    """
    first, second = np.sqrt(1.0 - chances[:, 0]), np.sqrt(chances[:, 0])
    one, two = 2.0 * np.pi * chances[:, 1], 2.0 * np.pi * chances[:, 2]
    return np.stack([first * np.sin(one), first * np.cos(one), second * np.sin(two), second * np.cos(two)], axis=1)


def _chances(stream: np.random.PCG64, count: int) -> Array:
    """The next numbers of a stream, from 0 to 1 without that, (n,)."""
    found: Array = (stream.random_raw(count) >> np.uint64(11)) * 2.0**-53
    return found


# --- places, about the position of the table and before its turn ---


def _places(
    table: GroupedPlacement, number: int, scales: Sequence[float], scattered: Taken, chance: Chance
) -> tuple[Array, Array | None]:
    """Places [m], (n, 3), and by how much each is turned about z [degrees], (n,), if at all."""
    if table.scatter is not None:
        return _scattered(table, table.scatter, number, scales, scattered, chance), None
    if table.along is not None:
        return _along(table.along, number, len(scales))
    return _lattice(table), None


def _lattice(table: GroupedPlacement) -> Array:
    """Rows along x, of them layers along y, of them storeys along z; the first body is where the table is."""
    assert table.spacing is not None, "a table without spacing, along and scatter is refused"
    if isinstance(table.count, int):
        step = table.spacing if isinstance(table.spacing, tuple) else (table.spacing, 0.0, 0.0)
        return np.arange(table.count)[:, None] * np.array(step)
    assert table.count is not None
    nx, ny, nz = table.count
    step = table.spacing if isinstance(table.spacing, tuple) else (table.spacing,) * 3
    steps = np.array([(i, j, k) for k, j, i in product(range(nz), range(ny), range(nx))], dtype=np.float64)
    places: Array = steps * np.array(step) + (steps[:, 2:] % 2.0) * np.array(table.offset)
    return places


def _along(curve: CurveParameters, number: int, count: int) -> tuple[Array, Array | None]:
    """Evenly spaced places on a curve, and its direction there seen from above [degrees]."""
    points = np.array(curve.points, dtype=np.float64)
    around = np.concatenate([points, points[:1]]) if curve.closed else points
    if (np.square(np.diff(around, axis=0)).sum(axis=1) == 0.0).any():
        raise KeyRefusedError((number, "along", "points"), "has the same point twice in a row; remove one")
    way = _smooth_way(points, closed=curve.closed)
    pieces = np.sqrt(np.square(np.diff(way, axis=0)).sum(axis=1))
    length = np.concatenate([[0.0], np.cumsum(pieces)])
    wanted = length[-1] * np.arange(count) / max(1, count if curve.closed else count - 1)
    piece = np.clip(np.searchsorted(length, wanted, side="right") - 1, 0, len(pieces) - 1)
    share = (wanted - length[piece]) / pieces[piece]
    direction = way[piece + 1] - way[piece]
    places = np.round(way[piece] + share[:, None] * direction, _PLACE_DIGITS)
    if not curve.turned:
        return places, None
    return places, np.round(np.degrees(np.arctan2(direction[:, 1], direction[:, 0])), _TURN_DIGITS)


def _smooth_way(points: Array, *, closed: bool) -> Array:
    """Corners of a fine line through points (n, 3): a centripetal Catmull-Rom curve, which has no loops.

    Catmull & Rom 1974, "A class of local interpolating splines"; Yuksel, Schaefer & Keyser 2011 on its knots.
    """
    if closed:
        ring = np.concatenate([points[-1:], points, points[:2]])
    else:
        ring = np.concatenate([2.0 * points[:1] - points[1:2], points, 2.0 * points[-1:] - points[-2:-1]])
    pieces = []
    for first in range(len(ring) - 3):
        a, b, c, d = ring[first : first + 4]
        knots = np.concatenate([[0.0], np.cumsum([_root_of_distance(*pair) for pair in ((a, b), (b, c), (c, d))])])
        t = (knots[1] + (knots[2] - knots[1]) * np.arange(PARTS_OF_CURVE) / PARTS_OF_CURVE)[:, None]
        lines = [_between(t, knots[i], knots[i + 1], *pair) for i, pair in enumerate(((a, b), (b, c), (c, d)))]
        bows = [_between(t, knots[i], knots[i + 2], lines[i], lines[i + 1]) for i in range(2)]
        pieces.append(_between(t, knots[1], knots[2], *bows))
    way: Array = np.concatenate([*pieces, ring[-2:-1]])
    return way


def _root_of_distance(a: Array, b: Array) -> float:
    return math.sqrt(math.sqrt(float(np.square(b - a).sum())))


def _between(t: Array, start: float, end: float, a: Array, b: Array) -> Array:
    """What is a at the start and b at the end, at times (k, 1)."""
    share = (t - start) / (end - start)
    return (1.0 - share) * a + share * b


# --- scattering ---


class Taken:
    """Balls in space that are taken, in cells of a grid by size: no two of them overlap."""

    def __init__(self) -> None:
        self._levels: dict[int, defaultdict[tuple[int, int, int], list[tuple[float, float, float, float]]]] = {}

    def has_room(self, x: float, y: float, z: float, radius: float) -> bool:
        """Whether a ball [m] overlaps none."""
        for level, cells in self._levels.items():
            edge = 2.0**level  # balls in it have a diameter of at most that
            reach = radius + 0.5 * edge
            spans = [range(math.floor((v - reach) / edge), math.floor((v + reach) / edge) + 1) for v in (x, y, z)]
            for cell in product(*spans):
                for a, b, c, r in cells.get(cell, ()):
                    if (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < (radius + r) ** 2:
                        return False
        return True

    def take(self, x: float, y: float, z: float, radius: float) -> None:
        """Take the room of a ball [m]."""
        level = math.frexp(2.0 * radius)[1]
        cells = self._levels.setdefault(level, defaultdict(list))
        cells[(math.floor(x / 2.0**level), math.floor(y / 2.0**level), math.floor(z / 2.0**level))].append(
            (x, y, z, radius)
        )


def _scattered(
    table: GroupedPlacement,
    scatter: ScatterParameters,
    number: int,
    scales: Sequence[float],
    taken: Taken,
    chance: Chance,
) -> Array:
    """Random places in a shape, of balls around the bodies that overlap no other scattered body, the largest first."""
    around = ball_around(table.shape)
    if around is None:
        raise KeyRefusedError(
            (number, "shape", "size"),
            "is missing; what is scattered needs the longest edge of its mesh [m], by which it gets room",
        )
    turn = rotation.from_degrees(table.rotation_deg)
    origin = np.array(table.position)
    half = np.array(box_around(scatter.shape))
    stream, places = chance.stream("places"), np.zeros((len(scales), 3))
    spare = 0.5 * scatter.gap + _jitter_reach(table)
    for done, index in enumerate(sorted(range(len(scales)), key=lambda each: (-scales[each], each))):
        radius = around * scales[index]
        for _ in range(MOST_TRIES):
            place = half * (2.0 * _chances(stream, 3) - 1.0)
            if depth_inside(scatter.shape, place) < radius + spare - 0.5 * scatter.gap:
                continue
            x, y, z = (float(value) for value in np.round(rotation.rotated(turn, place), _PLACE_DIGITS) + origin)
            if taken.has_room(x, y, z, radius + spare):
                taken.take(x, y, z, radius + spare)
                places[index] = place
                break
        else:
            raise KeyRefusedError(
                (number, "scatter"),
                f"has room for {done:,} of {len(scales):,} bodies: each takes a ball of up to "
                f"{2.0 * (around * max(scales) + spare):.3g} m, and such balls fill a third of a shape at most; give "
                "a larger shape, fewer or smaller bodies"
                + (", or a smaller gap" if scatter.gap else "")
                + "; or several groups, each in a shape above the other",
            )
    return places


def _jitter_reach(table: GroupedPlacement) -> float:
    return 0.0 if table.jitter is None else math.sqrt(sum(each * each for each in table.jitter.position))
