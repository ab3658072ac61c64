"""The look of wood: growth rings, fibres and pores in the axes of a body, and boards where it is the ground.

A trunk runs along a body's longest edge, its pith beside the body. Distances are counted in trunks, so that a toy has
as many rings as a beam; those of the ground in boards.
"""

from __future__ import annotations

import math
from typing import Any

from blender_scripts.geometry import REST_UV
from blender_scripts.shading import Color, LookContext, NodeBuilder, draws, or_default

OILED_OAK: Color = (0.36, 0.19, 0.085)
_RINGS = 9.0  # in a trunk's width
_PITH = (0.42, 0.31)
"""Where the rings have their middle, from the middle of the ground's boards [trunks]: rings are bows, not targets."""
_PITH_DISTANCE = (0.52, 0.2)
"""Of bodies, in any direction: in the mean, and how much more or less for one or the other [trunks]."""
_TRUNK_LENGTH = 40.0  # that bodies are cut from, to both sides of its middle [trunks]
_BRIGHTNESS, _WARMTH = 0.35, 0.1  # how much wood differs from body to body [stops]
_BOARD_WIDTH, _BOARD_LENGTH = 0.15, 1.35  # of the ground, in diagonals of the domain
_JOINT = 0.018  # half the width of the gap between boards [boards' widths]
_SHEET_TRUNK = 0.4  # width of the trunk that a sheet is cut from, in diagonals of the sheet


@draws("wood")
def _wood(builder: NodeBuilder, context: LookContext) -> None:
    """Oiled oak: late wood darker than early wood, fibres along the grain, a soft shine."""
    base = context.own_shade(or_default(context.color, OILED_OAK), brightness=_BRIGHTNESS, warmth=_WARMTH)
    position, tone, joint = _boards(builder, context) if context.surface == "ground" else _trunk(builder, context)
    # Trunks are not round: a slow noise, drawn out along the grain, bends the rings.
    bend = _noise(builder, position, (1.1, 1.1, 0.32), detail=2.0)
    across = builder.vector_math("MULTIPLY", position, (1.0, 1.0, 0.0))
    distance = builder.vector_math("LENGTH", builder.vector_math("ADD", across, _pith(builder, context)))
    radius = builder.math("ADD", distance, builder.math("MULTIPLY", bend, 0.45))
    phase = builder.math("FRACT", builder.math("MULTIPLY", radius, _RINGS))
    # Early wood darkens towards late wood slowly; the next year begins sharply.
    shades = ((0.0, 1.22), (0.45, 1.02), (0.82, 0.52), (0.9, 0.5), (1.0, 1.22))
    color = builder.ramp(phase, *((place, _shaded(base, shade)) for place, shade in shades))
    fibres = _noise(builder, position, (34.0, 34.0, 1.3), detail=3.0)
    pores = _noise(builder, position, (62.0, 62.0, 3.1), detail=1.0)
    pore = builder.math("MULTIPLY", builder.math("GREATER_THAN", pores, 0.62), 0.28)
    shade = builder.math("MULTIPLY_ADD", fibres, 0.5, 0.75)
    shade = builder.math("MULTIPLY", builder.math("SUBTRACT", shade, pore), builder.math("MULTIPLY", tone, joint))
    shader = builder.node(
        "ShaderNodeBsdfPrincipled",
        Base_Color=builder.own_tint(context, builder.scaled(color, shade), brightness=_BRIGHTNESS, warmth=_WARMTH),
        Roughness=or_default(context.roughness, 0.42),
        Specular_IOR_Level=0.35,
    )
    builder.surface(shader)


def _pith(builder: NodeBuilder, context: LookContext) -> Any:
    """Where the rings have their middle [trunks]: a vector, or the output socket of one."""
    if context.surface == "ground":
        return (*_PITH, 0.0)
    turn, farther = builder.own_numbers(context, 2)
    mean, most = _PITH_DISTANCE
    if not context.is_shared:
        distance = mean + most * farther
        return distance * math.cos(math.pi * turn), distance * math.sin(math.pi * turn), 0.0
    angle = builder.math("MULTIPLY", turn, math.pi)
    way = builder.combined(builder.math("COSINE", angle), builder.math("SINE", angle))
    return builder.scaled(way, builder.math("MULTIPLY_ADD", farther, most, mean))


def _trunk(builder: NodeBuilder, context: LookContext) -> tuple[Any, Any, Any]:
    """The place in the body's trunk, across twice and along it [trunks], and two factors that change nothing."""
    edges = context.edges or (context.domain_size,) * 3
    if context.surface == "sheet":
        coordinates = builder.node("ShaderNodeUVMap")
        coordinates.uv_map = REST_UV
        place, order, width = coordinates.outputs[0], [0, 2, 1], _SHEET_TRUNK * math.hypot(*edges)
    else:
        place = builder.node("ShaderNodeTexCoord").outputs["Object"]
        order = sorted(range(3), key=lambda axis: edges[axis])  # the trunk runs along the longest, as wide as the next
        width = edges[order[1]]
    parts = builder.split(builder.scaled(place, 1.0 / max(width, 1e-9)))
    # No two bodies come from the same place of it.
    (along,) = builder.own_numbers(context, 1)
    place = builder.combined(*(parts[axis] for axis in order))
    if context.is_shared:
        farther = builder.combined(0.0, 0.0, builder.math("MULTIPLY", along, _TRUNK_LENGTH))
    else:
        farther = (0.0, 0.0, _TRUNK_LENGTH * along)
    return builder.vector_math("ADD", place, farther), 1.0, 1.0


def _boards(builder: NodeBuilder, context: LookContext) -> tuple[Any, Any, Any]:
    """The place in the trunk that a board was sawn from [trunks], how light the board is, and 0 in the joints."""
    size = context.domain_size
    x, y, _ = builder.split(builder.node("ShaderNodeTexCoord").outputs["Object"])
    row = builder.math("DIVIDE", x, _BOARD_WIDTH * size)
    number = builder.math("FLOOR", row)
    across = builder.math("SUBTRACT", row, number)
    # Boards of neighbouring rows end at different places.
    start, _ = _random(builder, number, 0.0, 0.0)
    along = builder.math("ADD", builder.math("DIVIDE", y, _BOARD_LENGTH * size), start)
    which = builder.math("FLOOR", along)
    fraction = builder.math("SUBTRACT", along, which)
    lightness, shift = _random(builder, number, which, 1.0)
    place = builder.combined(across, 0.0, builder.math("DIVIDE", y, _BOARD_WIDTH * size))
    moved = builder.vector_math("MULTIPLY_ADD", shift, (2.4, 1.2, 40.0), place)
    # Distance from the nearest joint, in boards' widths.
    to_side = builder.math("MINIMUM", across, builder.math("SUBTRACT", 1.0, across))
    to_end = builder.math("MINIMUM", fraction, builder.math("SUBTRACT", 1.0, fraction))
    distance = builder.math("MINIMUM", to_side, builder.math("MULTIPLY", to_end, _BOARD_LENGTH / _BOARD_WIDTH))
    joint = builder.smoothstep(distance, 0.3 * _JOINT, _JOINT, start=0.25)
    return moved, builder.math("MULTIPLY_ADD", lightness, 0.5, 0.75), joint


def _random(builder: NodeBuilder, x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    """A number and a vector from 0 to 1 for each triple of whole numbers."""
    noise = builder.node("ShaderNodeTexWhiteNoise", Vector=builder.combined(x, y, z))
    return noise.outputs["Value"], noise.outputs["Color"]


def _noise(builder: NodeBuilder, place: Any, scale: Color, *, detail: float) -> Any:
    """Noise about 0.5 with `scale` features a unit along each axis."""
    return builder.noise(builder.vector_math("MULTIPLY", place, scale), Scale=1.0, Detail=detail, Roughness=0.55)


def _shaded(color: Color, factor: float) -> Color:
    red, green, blue = (min(1.0, factor * channel) for channel in color)
    return red, green, blue
