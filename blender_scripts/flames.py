"""The light of flames: lamps that stand in for what glows in a volume.

A renderer finds the glow of a volume by chance only, when a ray that left the ground happens to pass through it; a lamp
it aims at. So the glow is cut into blocks, and each block shines as one ball of the same place, size, colour and power.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blender_scripts.black_body import black_body_color, relative_luminance
from blender_scripts.errors import RenderInputError
from blender_scripts.openvdb_binding import import_openvdb
from blender_scripts.shading import SmokeBox

BLOCKS_ALONG_EDGE = 4
"""Blocks along the longest edge of the smoke's box. They stand still, so that no lamp jumps from frame to frame."""
_DIMMEST_SHARE = 2.0e-3  # of all the light; a block that gives less gets no lamp
_COLDEST_K = 700.0  # below this nothing glows: a ninety-millionth of the light at 1500 K [K]
_SLAB_CELLS = 32


@dataclass(frozen=True)
class Glow:
    """The light of a fire, from its look and its box.

    Attributes:
        extinction: per metre at density 1 [1/m].
        emission: radiance of a thick flame at the flame temperature [-].
        flame_temperature: [K].
        box: of the smoke; the look fades towards its open faces.
        fade_width: distance from them on which it fades [m]; 0: it does not.
    """

    extinction: float
    emission: float
    flame_temperature: float
    box: SmokeBox
    fade_width: float = 0.0


@dataclass(frozen=True)
class Lamp:
    """A ball that shines as a block of flames does: its centre and radius [m], and power in all directions.

    The power is in W where a radiance of 1 is 1 W/(m² sr), linear Rec. 709.
    """

    position: tuple[float, float, float]
    radius: float
    power: tuple[float, float, float]


def lamps_of_file(path: Path, glow: Glow) -> list[Lamp]:
    """The lamps for one frame's volume.

    Raises:
        RenderInputError: the file has no `density` or no `temperature` grid.
    """
    grids = {grid.name: grid for grid in import_openvdb().readAll(str(path))[0]}
    for name in ("density", "temperature"):
        if name not in grids:
            raise RenderInputError(f"the volume {path} has no grid named {name}, which the look of fire needs")
    return lamps_of_grids(grids["density"], grids["temperature"], glow)


def lamps_of_grids(density: Any, temperature: Any, glow: Glow) -> list[Lamp]:
    """The lamps for a pair of OpenVDB grids of one transform: density [-] and temperature above ambient [K].

    Each cell of volume dV at density rho and temperature T emits 4 pi rho extinction emission L(T) / L(T_flame) dV in
    the colour of a black body, less the fade at open faces, as the look's shader has it. What the smoke absorbs on the
    way out is left to the renderer. A block's ball has the glow's own centre, and half its radius.
    """
    if glow.emission == 0.0 or temperature.activeVoxelCount() == 0:
        return []
    cell_size = temperature.transform.voxelSize()[0]
    origin = np.array(temperature.transform.indexToWorld((0, 0, 0)))
    low, high = (np.array(corner) for corner in temperature.evalActiveVoxelBoundingBox())
    box_min = np.array(glow.box.box_min)
    block_size = float((np.array(glow.box.box_max) - box_min).max()) / BLOCKS_ALONG_EDGE
    shape = np.ceil((np.array(glow.box.box_max) - box_min) / block_size - 1e-6).astype(int)
    sums = np.zeros((int(shape.prod()), 8))  # light, light x, y, z, light |x|², red, green, blue
    for first in range(low[0], high[0] + 1, _SLAB_CELLS):
        start = np.array((first, low[1], low[2]))
        cells = np.minimum(high + 1 - start, (_SLAB_CELLS, *(high + 1 - start)[1:]))
        smoke, heat = np.zeros(cells, np.float32), np.zeros(cells, np.float32)
        density.copyToArray(smoke, ijk=tuple(map(int, start)))
        temperature.copyToArray(heat, ijk=tuple(map(int, start)))
        hot = (heat > _COLDEST_K - glow.box.ambient_temperature) & (smoke > 0)
        kelvin = heat[hot].astype(np.float64) + glow.box.ambient_temperature
        position = origin + cell_size * (np.argwhere(hot) + start)
        light = smoke[hot] * relative_luminance(kelvin, glow.flame_temperature) * _fade(position, glow)
        block = np.clip(((position - box_min) / block_size).astype(int), 0, shape - 1)
        index = np.ravel_multi_index(tuple(block.T), tuple(shape))
        position -= box_min  # from a corner near by, so that the sums of squares keep their digits
        moments = (np.ones_like(light), *position.T, (position**2).sum(axis=1), *black_body_color(kelvin).T)
        for column, moment in enumerate(moments):
            sums[:, column] += np.bincount(index, light * moment, minlength=len(sums))

    scale = 4.0 * math.pi * glow.extinction * glow.emission * cell_size**3
    lamps = []
    for light, *rest in sums[sums[:, 0] > _DIMMEST_SHARE * sums[:, 0].sum()]:
        centre = np.array(rest[:3]) / light
        mean_square_radius = max(rest[3] / light - float(centre @ centre), 0.0)
        # Of a full ball it is 3/5 R². A lamp shines from its surface; with R / 2 its light crosses as much smoke on its
        # way out as the glow's does. A single cell still has the size of a cell.
        radius = max(0.5 * math.sqrt(5.0 / 3.0 * mean_square_radius), 0.5 * cell_size)
        lamps.append(Lamp(tuple(map(float, centre + box_min)), radius, tuple(float(scale * c) for c in rest[4:])))
    return lamps


def _fade(position: NDArray[np.float64], glow: Glow) -> NDArray[np.float64]:
    """Share of the smoke that the look's fade leaves at positions [m] (n, 3): from 0 at open faces to 1 [-], (n,)."""
    if glow.fade_width == 0.0:
        return np.ones(len(position))
    distance = np.full(len(position), np.inf)
    for axis, name in enumerate("xyz"):
        if f"{name}-" in glow.box.open_faces:
            distance = np.minimum(distance, position[:, axis] - glow.box.box_min[axis])
        if f"{name}+" in glow.box.open_faces:
            distance = np.minimum(distance, glow.box.box_max[axis] - position[:, axis])
    part = np.clip(distance / glow.fade_width, 0.0, 1.0)
    return part * part * (3.0 - 2.0 * part)  # smoothstep, as the shader has it
