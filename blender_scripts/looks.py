"""Looks of surfaces: what a body is made of, each by a function that builds its shader nodes.

`look_table` tells how to add a look. Those of volumes, weaves and wood have modules of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import bpy

from blender_scripts import smoke_looks, weaves, wood  # noqa: F401 - they register their looks
from blender_scripts.geometry import COVER_INDEX, COVERED, DYE, DYE_BEHIND, WET
from blender_scripts.optics import (
    INSIDES,
    JUICE_REFLECTANCE,
    MUD_REFLECTANCE,
    REFRACTIVE_INDEX,
    dye_per_metre,
    per_metre,
)
from blender_scripts.shading import LOOKS, Color, LookContext, NodeBuilder, draws, or_default

HONEY_SCATTERING_PER_M = 40.0
HONEY_ANISOTROPY = 0.8
"""Pollen, wax and fine crystals scatter forwards, chosen by eye: without them a thin stream in a dark room is olive."""

MILK_REFLECTANCE: Color = (0.91, 0.88, 0.76)
"""Diffuse reflectance of whole milk for red, green and blue light [-] (Jensen et al. 2001, fig. 5)."""


MIST_GOES_FORWARD = 0.85
"""Share of the light through drops that are no points that keeps its direction [-]: the asymmetry of scattering by
balls of water in geometric optics (Bohren & Huffman 1983). Scattered evenly, the rest carries as much light aside."""

WHITE: Color = (1.0, 1.0, 1.0)
MIST: Color = (0.97, 0.985, 1.0)
"""Light that leaves a drop of water, and what drops that are no points scatter."""

SMALLEST_DROP = 1.0
"""Radius of drops at least [pixels]; fewer of these stand for smaller ones."""

BENT_BY_DROPS = 2
"""How many drops bend a path, each and other surfaces counted."""


def new_material(name: str, look: str, context: LookContext) -> Any:
    """A Blender material with a look, for the body of a name."""
    material = bpy.data.materials.new(name)
    LOOKS[look](NodeBuilder(material), context)
    return material


def _clear(builder: NodeBuilder, context: LookContext, *, look: str, tint: Color) -> None:
    """A clear liquid that absorbs, and lets light through to what lies under it."""
    _clear_surface(builder, context, look=look, tint=tint)
    builder.volume(_homogeneous_absorption(builder, per_metre(look, context.inner_density, context.color)))


draws("water")(partial(_clear, look="water", tint=(0.94, 0.975, 1.0)))
# What a surface reflects alone dims the light that goes straight through: the colour is the inside's.
draws("wine")(partial(_clear, look="wine", tint=(0.96, 0.96, 0.96)))
draws("oil")(partial(_clear, look="oil", tint=(0.94, 0.94, 0.94)))
draws("coffee")(partial(_clear, look="coffee", tint=(0.96, 0.96, 0.96)))
draws("ink")(partial(_clear, look="ink", tint=(0.96, 0.96, 0.96)))


def _clear_surface(
    builder: NodeBuilder, context: LookContext, *, look: str, tint: Color, color: Color = (1.0, 1.0, 1.0)
) -> None:
    """The surface of what is clear, which lets light through to what lies under it in a tint.

    Dye is seen through it: light loses half of what all the dye behind takes where it enters, half where it leaves.
    """
    entering: Any = (1.0, 1.0, 1.0)
    color_of_base: Any = color
    if context.dye_color is not None and look in INSIDES:
        entering = _through_dye(builder, dye_per_metre(look, context.inner_density, context.color, context.dye_color))
        # The shader takes the root of it for what enters, and for what leaves.
        color_of_base = builder.vector_math("MULTIPLY", builder.vector_math("MULTIPLY", entering, entering), color)
        tint = builder.vector_math("MULTIPLY", entering, tint)
    shader = builder.node(
        "ShaderNodeBsdfPrincipled",
        Base_Color=color_of_base,
        Roughness=or_default(context.roughness, 0.0),
        IOR=_relative_index(builder, context, REFRACTIVE_INDEX[look]),
        Transmission_Weight=1.0,
    )
    builder.surface(_refracting(builder, context, shader, tint=tint, straight_tint=entering))


def _through_dye(builder: NodeBuilder, taken: Color) -> Any:
    """The output socket of what is left of light after half of the dye behind a surface, which takes so much [1/m]."""
    behind = builder.node("ShaderNodeAttribute")
    behind.attribute_name = DYE_BEHIND
    depths = (builder.math("MULTIPLY", behind.outputs[2], -0.5 * each) for each in taken)
    return builder.combined(*(builder.math("EXPONENT", each) for each in depths))


def _relative_index(builder: NodeBuilder, context: LookContext, own: float) -> Any:
    """Refractive index against what is outside: a liquid where one covers the body, else air."""
    if not context.is_covered:
        return own
    covered, index = (builder.node("ShaderNodeAttribute") for _ in range(2))
    covered.attribute_name, index.attribute_name = COVERED, COVER_INDEX
    is_covered = builder.math("GREATER_THAN", covered.outputs[2], 0.5)
    outside = builder.math("MULTIPLY_ADD", is_covered, index.outputs[2], 1.0)
    return builder.math("DIVIDE", own, outside)


@draws("honey")
def _honey(builder: NodeBuilder, context: LookContext) -> None:
    """Amber that absorbs blue first, a little cloudy."""
    _clear_surface(builder, context, look="honey", tint=(1.0, 0.97, 0.9))
    absorption = per_metre("honey", context.inner_density, context.color)
    scattering = builder.node(
        "ShaderNodeVolumeScatter",
        Color=(1.0, 1.0, 1.0),
        Density=HONEY_SCATTERING_PER_M * context.inner_density,
        Anisotropy=HONEY_ANISOTROPY,
    )
    both = builder.node("ShaderNodeAddShader")
    for shader, socket in zip((_homogeneous_absorption(builder, absorption), scattering), both.inputs, strict=True):
        builder.link(shader.outputs[0], socket)
    builder.volume(both)


def _with_dye(
    builder: NodeBuilder, context: LookContext, color: Any, shaded: Callable[[Color], Any] = lambda color: color
) -> Any:
    """A colour or its socket, or the socket of what dye makes of it, whose own colour is shaded in the same way."""
    if context.dye_color is None:
        return color
    dye = builder.node("ShaderNodeAttribute")
    dye.attribute_name = DYE
    return builder.mix_colors(dye.outputs[2], color, shaded(context.dye_color))


def _cloudy(builder: NodeBuilder, context: LookContext, *, look: str, reflectance: Color) -> None:
    """A liquid that light enters and leaves elsewhere, red the farthest, under a wet surface; dye tints it."""
    color = _with_dye(builder, context, or_default(context.color, reflectance))
    shader = builder.node(
        "ShaderNodeBsdfPrincipled",
        Base_Color=color,
        Roughness=or_default(context.roughness, 0.06),
        IOR=REFRACTIVE_INDEX[look],
        Subsurface_Weight=1.0,
        Subsurface_Scale=1.0,
        Subsurface_Radius=tuple(1.0 / each for each in per_metre(look, context.inner_density)),
    )
    if context.wets:
        # Where it touches glass that glass mirrors what there is to mirror between the two.
        free = builder.math("SUBTRACT", 1.0, _wetness(builder))
        builder.link(builder.math("MULTIPLY", 0.5, free), shader.inputs["Specular IOR Level"])
    # Paths that follow the light inside; the node's other method is tuned for skin.
    shader.subsurface_method = "RANDOM_WALK"
    builder.surface(shader)


draws("milk")(partial(_cloudy, look="milk", reflectance=MILK_REFLECTANCE))
draws("juice")(partial(_cloudy, look="juice", reflectance=JUICE_REFLECTANCE))
draws("muddy_water")(partial(_cloudy, look="muddy_water", reflectance=MUD_REFLECTANCE))


@draws("glass")
def _glass(builder: NodeBuilder, context: LookContext) -> None:
    own, tint = (or_default(context.color, color) for color in ((0.97, 0.99, 0.98), (0.90, 0.93, 0.92)))
    _clear_surface(builder, context, look="glass", tint=tint, color=own)


@draws("stone")
def _stone(builder: NodeBuilder, context: LookContext) -> None:
    """Grey rock: mottled colour and a rough surface from noise in the body's own coordinates, so it does not swim."""
    stone = context.own_shade(or_default(context.color, (0.32, 0.30, 0.28)), brightness=0.35, warmth=0.1)
    coordinates = builder.node("ShaderNodeTexCoord").outputs
    # The mottling has the same number of spots on a pebble as on a boulder: 'Generated' spans the body's box. Ground
    # that reaches to the horizon has as many in the domain's size.
    is_ground = context.surface == "ground"
    place = coordinates["Object" if is_ground else "Generated"]
    scale = 7.0 / context.domain_size if is_ground else 7.0
    if not is_ground:
        numbers = builder.own_numbers(context, 3)
        way = (
            builder.scaled(builder.combined(*numbers), 10.0) if context.is_shared else [10.0 * each for each in numbers]
        )
        place = builder.vector_math("ADD", place, way)
    noise = builder.noise(place, Scale=scale, Detail=6.0, Roughness=0.62)
    depth = 0.006 * context.domain_size if context.edges is None else 0.03 * math.hypot(*context.edges)

    def mottled(color: Color) -> Any:
        red, green, blue = color
        dark = (0.55 * red, 0.55 * green, 0.55 * blue)
        light = (min(1.0, 1.35 * red), min(1.0, 1.35 * green), min(1.0, 1.35 * blue))
        return builder.ramp(noise, (0.3, dark), (0.72, light))

    bump = builder.node("ShaderNodeBump", Strength=0.35, Distance=depth, Height=noise)
    shader = builder.node(
        "ShaderNodeBsdfPrincipled",
        Base_Color=builder.own_tint(
            context, _with_dye(builder, context, mottled(stone), mottled), brightness=0.35, warmth=0.1
        ),
        Roughness=or_default(context.roughness, 0.8),
        Specular_IOR_Level=0.3,
        Normal=bump.outputs["Normal"],
    )
    builder.surface(shader)


@draws("spray")
def _spray(builder: NodeBuilder, context: LookContext) -> None:
    """Droplets in the air: too small to refract in a picture, so they are white and let some light straight through."""
    white = _scattering(builder, or_default(context.color, (0.96, 0.98, 1.0)))
    glint = builder.node("ShaderNodeBsdfGlossy", Roughness=or_default(context.roughness, 0.25))
    fresnel = builder.node("ShaderNodeFresnel", IOR=REFRACTIVE_INDEX["water"])
    droplet = builder.mix_shaders(fresnel.outputs[0], white, glint)
    builder.surface(builder.mix_shaders(0.45, droplet, builder.node("ShaderNodeBsdfTransparent")))


@draws("drops")
def _drops(builder: NodeBuilder, context: LookContext) -> None:
    """Drops of a clear liquid: small lenses that show what is behind them upside down; mist on what is no point.

    Points are hit on their front only, so what enters leaves there, in the direction that both refractions give it.
    That is one refraction with an index of its own for each angle. A path goes straight through drops once
    `BENT_BY_DROPS` of them, or as many other surfaces, have bent it: in dense spray it would end in one, black. A
    colour is that of the liquid through a drop, whichever way light leaves it; dye goes from it to its own.
    """
    color, scattered_color = (_with_dye(builder, context, or_default(context.color, each)) for each in (WHITE, MIST))
    index = REFRACTIVE_INDEX["water"]
    lens = builder.node("ShaderNodeBsdfRefraction", Color=color, Roughness=0.0, IOR=_index_of_ball(builder, index))
    through = builder.node("ShaderNodeBsdfTransparent", Color=color)
    path = builder.node("ShaderNodeLightPath").outputs
    bent = builder.math("GREATER_THAN", path["Transmission Depth"], BENT_BY_DROPS - 0.5)
    drop = builder.mix_shaders(bent, lens, through)
    scattered = _scattering(builder, scattered_color)
    mist = builder.mix_shaders(MIST_GOES_FORWARD, scattered, through)
    is_point = builder.math("GREATER_THAN", builder.node("ShaderNodePointInfo").outputs["Radius"], 0.0)
    inner = builder.mix_shaders(is_point, mist, drop)
    mirror = builder.node("ShaderNodeBsdfGlossy", Roughness=or_default(context.roughness, 0.05))
    fresnel = builder.node("ShaderNodeFresnel", IOR=index)
    builder.surface(builder.mix_shaders(fresnel.outputs[0], inner, mirror))


def _index_of_ball(builder: NodeBuilder, index: float) -> Any:
    """The output socket of the index whose one refraction turns light as far as a ball of an index does with two.

    Light at an angle a to the normal is at b inside, sin b = sin a / index, and leaves at 2 (a - b) from its way. The
    reciprocal of what is looked for is sin(2 b - a) / sin a = 2 cos a cos b / index + 2 sin² b - 1.
    """
    geometry = builder.node("ShaderNodeNewGeometry").outputs
    cosine = builder.vector_math("DOT_PRODUCT", geometry["Incoming"], geometry["Normal"])
    square = builder.math("MULTIPLY", cosine, cosine)
    sine_inside = builder.math("DIVIDE", builder.math("SUBTRACT", 1.0, square), index**2)  # squared
    inside = builder.math("SQRT", builder.math("SUBTRACT", 1.0, sine_inside))
    both = builder.math("MULTIPLY", builder.math("MULTIPLY", cosine, inside), 2.0 / index)
    return builder.math("DIVIDE", 1.0, builder.math("ADD", both, builder.math("MULTIPLY_ADD", sine_inside, 2.0, -1.0)))


@draws("foam")
def _foam(builder: NodeBuilder, context: LookContext) -> None:
    """Bubbles packed at the surface, which scatter light in all directions."""
    builder.surface(_scattering(builder, or_default(context.color, (0.93, 0.95, 0.96))))


@draws("bubbles")
def _bubbles(builder: NodeBuilder, context: LookContext) -> None:
    """Air in water: mirrors beyond the critical angle of 48.6°, where Fresnel's reflection is total, clear before it.

    Points are hit on their front only, so what passes goes on straight instead of being refracted twice.
    """
    fresnel = builder.node("ShaderNodeFresnel", IOR=1.0 / REFRACTIVE_INDEX["water"])
    mirror = builder.node("ShaderNodeBsdfGlossy", Roughness=or_default(context.roughness, 0.0))
    through = builder.node("ShaderNodeBsdfTransparent", Color=or_default(context.color, (0.97, 0.985, 1.0)))
    builder.surface(builder.mix_shaders(fresnel.outputs[0], through, mirror))


@draws("sand")
def _sand(builder: NodeBuilder, context: LookContext) -> None:
    """Grains of quartz and feldspar: each of a shade of its own, a few of them dark, and dull."""
    number = builder.node("ShaderNodePointInfo").outputs["Random"]

    def shaded(color: Color) -> Any:
        red, green, blue = color
        dark = (0.35 * red, 0.35 * green, 0.35 * blue)
        light = (min(1.0, 1.3 * red), min(1.0, 1.3 * green), min(1.0, 1.35 * blue))
        return builder.ramp(number, (0.04, dark), (0.15, (0.8 * red, 0.8 * green, 0.8 * blue)), (0.95, light))

    _even(builder, context, color=(0.56, 0.40, 0.24), roughness=0.75, shaded=shaded, Specular_IOR_Level=0.3)


@draws("snow")
def _snow(builder: NodeBuilder, context: LookContext) -> None:
    """Grains of ice that scatter light many times, a trace bluer the deeper it went; some are turned to the sun."""
    number = builder.node("ShaderNodePointInfo").outputs["Random"]
    glint = builder.math("GREATER_THAN", number, 0.97)
    _even(
        builder,
        context,
        color=(0.93, 0.95, 0.98),
        roughness=builder.math("SUBTRACT", 0.6, builder.math("MULTIPLY", glint, 0.5)),
        Subsurface_Weight=0.4,
        Subsurface_Scale=0.01,
    )


@draws("jelly")
def _jelly(builder: NodeBuilder, context: LookContext) -> None:
    """Gelatine with fruit: most light goes through and comes out coloured, some is scattered, under a wet skin."""
    _even(
        builder,
        context,
        color=(0.85, 0.06, 0.05),
        roughness=0.06,
        Subsurface_Weight=0.3,
        Subsurface_Scale=0.03,
        Transmission_Weight=0.8,
        IOR=1.35,
    )


@draws("tank_glass")
def _tank_glass(builder: NodeBuilder, context: LookContext) -> None:
    """Thin glass: reflects as glass does, and lets everything else straight through, so that it costs no bounces."""
    fresnel = builder.node("ShaderNodeFresnel", IOR=1.35)
    reflection = builder.node("ShaderNodeBsdfGlossy", Roughness=or_default(context.roughness, 0.0))
    through = builder.node("ShaderNodeBsdfTransparent", Color=or_default(context.color, (0.975, 0.99, 0.985)))
    is_camera_ray = builder.node("ShaderNodeLightPath").outputs["Is Camera Ray"]
    seen = builder.math("MULTIPLY", fresnel.outputs[0], is_camera_ray)
    builder.surface(builder.mix_shaders(seen, through, reflection))


@draws("metal")
def _metal(builder: NodeBuilder, context: LookContext) -> None:
    """Steel, of another melt and polish for each body."""
    shades = {"brightness": 0.1, "warmth": 0.05}
    color = builder.own_tint(context, context.own_shade((0.62, 0.61, 0.60), **shades), **shades)
    roughness: Any
    if context.is_shared:
        polish = builder.math("POWER", 2.0, builder.math("MULTIPLY", builder.own_numbers(context, 3)[2], 0.35))
        roughness = builder.math("MULTIPLY", polish, 0.28)
    else:
        roughness = 0.28 * 2.0 ** (0.35 * context.own_numbers(3)[2])
    _even(builder, context, color=color, roughness=roughness, Metallic=1.0)


def _even(
    builder: NodeBuilder,
    context: LookContext,
    *,
    color: Any,
    roughness: Any,
    shaded: Callable[[Any], Any] = lambda color: color,
    **inputs: float,
) -> None:
    """An opaque surface of one colour, or of shades of one; other inputs of the shader by name."""
    builder.surface(
        builder.node(
            "ShaderNodeBsdfPrincipled",
            Base_Color=_with_dye(builder, context, shaded(or_default(context.color, color)), shaded),
            Roughness=or_default(context.roughness, roughness),
            **inputs,
        )
    )


draws("rubber")(partial(_even, color=(0.95, 0.56, 0.02), roughness=0.42, Specular_IOR_Level=0.45))
draws("ceramic")(partial(_even, color=(0.82, 0.79, 0.74), roughness=0.35, Coat_Weight=0.6, Coat_Roughness=0.06))
draws("plastic")(partial(_even, color=(0.62, 0.06, 0.05), roughness=0.25, IOR=1.46))
# The cut edge of a pane, where glass shows its green.
draws("tank_edge")(partial(_even, color=(0.50, 0.72, 0.66), roughness=0.15, Specular_IOR_Level=0.6))


def _scattering(builder: NodeBuilder, color: Color) -> Any:
    """White that glows through: half of the light that meets a particle leaves it on the other side."""
    back = builder.node("ShaderNodeBsdfDiffuse", Color=color)
    return builder.mix_shaders(0.5, back, builder.node("ShaderNodeBsdfTranslucent", Color=color))


def _refracting(
    builder: NodeBuilder, context: LookContext, shader: Any, *, tint: Any, straight_tint: Any = (1.0, 1.0, 1.0)
) -> Any:
    """The shader of a clear body: shadow rays pass straight, and all light does where a fluid wets a solid.

    Without caustics, refractive things cast black shadows: no light sampled from behind them arrives. Rays that ask
    for light therefore meet a clear, slightly tinted surface. With them, light keeps being bent on its way to what a
    fluid wets, as Cycles follows it through refracting surfaces alone.
    """
    if context.caustics and not context.wets:
        return shader
    for_light = _asks_for_light(builder)
    if not context.caustics:
        clear = builder.node("ShaderNodeBsdfTransparent", Color=tint)
        shader = builder.mix_shaders(for_light, shader, clear)
    if not context.wets:
        return shader
    straight = _wetness(builder)
    if context.caustics:
        straight = builder.math("MULTIPLY", straight, builder.math("SUBTRACT", 1.0, for_light))
    return builder.mix_shaders(straight, shader, builder.node("ShaderNodeBsdfTransparent", Color=straight_tint))


def _wetness(builder: NodeBuilder) -> Any:
    """The output socket of how far a fluid touches solids: 1 where it does, 0 where its surface is free."""
    wet = builder.node("ShaderNodeAttribute")
    wet.attribute_name = WET
    return wet.outputs[2]


def _asks_for_light(builder: NodeBuilder) -> Any:
    """The output socket of what is 1 for shadow rays and for bounces off matt surfaces and smoke."""
    light_path = builder.node("ShaderNodeLightPath")
    asks_for_light = light_path.outputs["Is Shadow Ray"]
    for kind in ("Is Diffuse Ray", "Is Volume Scatter Ray"):
        asks_for_light = builder.math("MAXIMUM", asks_for_light, light_path.outputs[kind])
    return asks_for_light


def _homogeneous_absorption(builder: NodeBuilder, coefficients: tuple[float, ...]) -> Any:
    """Beer-Lambert absorption [1/m] inside the body. Cycles' node absorbs density (1 - colour)."""
    density = max(coefficients)
    color = tuple(1.0 - value / density for value in coefficients)
    return builder.node("ShaderNodeVolumeAbsorption", Color=color, Density=density)
