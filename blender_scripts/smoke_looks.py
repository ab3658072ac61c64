"""Looks of volumes: smoke, and fire, which is smoke that glows where it is hot; and embers."""

from __future__ import annotations

from typing import Any

from blender_scripts.black_body import LUMINANCE_EXPONENT_K
from blender_scripts.flames import Glow
from blender_scripts.geometry import EMBER_TEMPERATURE
from blender_scripts.shading import Color, LookContext, NodeBuilder, SmokeBox, draws, or_default

_EDGE_FADE = 0.08  # width of the fade at open faces, in shortest edges of the box
_FAR = 1.0e6  # distance of a face that does not fade [m]
DEFAULT_FLAME_TEMPERATURE_K = 1500.0  # of wood fires: 1100 to 1600 K where they glow
DEFAULT_EMISSION = 30.0
"""Flames are thin: some tenth of this reaches the eye, a few times what white paper does in a studio."""


@draws("smoke")
def _smoke(builder: NodeBuilder, context: LookContext) -> None:
    """Light smoke that scatters forwards a little; extinction follows the `density` grid."""
    _principled(builder, context, color=(0.86, 0.88, 0.90))


@draws("fire")
def _fire(builder: NodeBuilder, context: LookContext) -> None:
    """Sooty smoke that glows as a black body does, by the `temperature` grid.

    Emission per metre is extinction x emission x L(T) / L(T_flame) in the colour of a black body of T (Kirchhoff: what
    is dense enough to hide what is behind it glows the most), so thick flames have the radiance `emission` at the flame
    temperature whatever their density.
    """
    glow = glow_of(context)
    shader, extinction = _principled(builder, context, color=(0.42, 0.40, 0.38))
    kelvin = builder.math("ADD", _grid(builder, "temperature"), glow.box.ambient_temperature)
    luminance, color = _black_body(builder, kelvin, glow.flame_temperature)
    # Lamps stand in for the glow (`flames`) where a ray would find it by chance only.
    path = builder.node("ShaderNodeLightPath")
    by_chance = builder.math("MAXIMUM", path.outputs["Is Diffuse Ray"], path.outputs["Is Volume Scatter Ray"])
    seen = builder.math("MULTIPLY", builder.math("SUBTRACT", 1.0, by_chance), glow.emission)
    per_metre = builder.math("MULTIPLY", extinction, _grid(builder, "density"))
    strength = builder.math("MULTIPLY", builder.math("MULTIPLY", luminance, per_metre), seen)
    builder.link(strength, shader.inputs["Emission Strength"])
    builder.link(color, shader.inputs["Emission Color"])


@draws("embers")
def _embers(builder: NodeBuilder, context: LookContext) -> None:
    """Char that glows as a black body does, as bright as thick flames of its temperature are in the look `fire`."""
    reference = or_default(context.flame_temperature, DEFAULT_FLAME_TEMPERATURE_K)
    luminance, color = _black_body(builder, _grid(builder, EMBER_TEMPERATURE), reference)
    emission = or_default(context.emission, DEFAULT_EMISSION)
    glow = builder.node("ShaderNodeEmission", Color=color, Strength=builder.math("MULTIPLY", luminance, emission))
    builder.surface(glow)


def _black_body(builder: NodeBuilder, kelvin: Any, reference: float) -> tuple[Any, Any]:
    """Luminance over that at a reference temperature [K], and colour, of black bodies: output sockets."""
    exponent = builder.math("MULTIPLY_ADD", builder.math("DIVIDE", 1.0, kelvin), -LUMINANCE_EXPONENT_K, 0.0)
    luminance = builder.math("EXPONENT", builder.math("ADD", exponent, LUMINANCE_EXPONENT_K / reference))
    return luminance, builder.node("ShaderNodeBlackbody", Temperature=kelvin).outputs[0]


def glow_of(context: LookContext) -> Glow:
    """The light of a fire, as its look has it."""
    return Glow(
        extinction=context.inner_density,
        emission=or_default(context.emission, DEFAULT_EMISSION),
        flame_temperature=or_default(context.flame_temperature, DEFAULT_FLAME_TEMPERATURE_K),
        box=_box(context),
        fade_width=_fade_width(context),
    )


def _principled(builder: NodeBuilder, context: LookContext, *, color: Color) -> tuple[Any, Any]:
    """A volume that scatters and absorbs: its node, and its extinction at density 1 [1/m] as a number or socket."""
    extinction: Any = context.inner_density
    fade = _fade(builder, context)
    if fade is not None:
        extinction = builder.math("MULTIPLY", fade, extinction)
    # The node multiplies its density by the grid of the name in "Density Attribute", `density` unless changed.
    shader = builder.node(
        "ShaderNodeVolumePrincipled",
        Color=or_default(context.color, color),
        Anisotropy=or_default(context.anisotropy, 0.3),
        Density=extinction,
    )
    builder.volume(shader)
    return shader, extinction


def _fade(builder: NodeBuilder, context: LookContext) -> Any | None:
    """0 at the open faces of the box, 1 from the fade's width inwards; None where nothing fades.

    Smoke that leaves would otherwise end in a flat cut, where its box does.
    """
    box, width = _box(context), _fade_width(context)
    if not box.open_faces or width == 0.0:
        return None
    low = tuple(x if f"{axis}-" in box.open_faces else -_FAR for axis, x in zip("xyz", box.box_min, strict=True))
    high = tuple(x if f"{axis}+" in box.open_faces else _FAR for axis, x in zip("xyz", box.box_max, strict=True))
    position = builder.node("ShaderNodeNewGeometry").outputs["Position"]
    inwards = builder.vector_math("SUBTRACT", position, low), builder.vector_math("SUBTRACT", high, position)
    x, y, z = builder.split(builder.vector_math("MINIMUM", *inwards))
    distance = builder.math("MINIMUM", builder.math("MINIMUM", x, y), z)
    return builder.smoothstep(distance, 0.0, width)


def _fade_width(context: LookContext) -> float:
    """Distance from open faces on which smoke fades [m]."""
    box = _box(context)
    size = [high - low for low, high in zip(box.box_min, box.box_max, strict=True)]
    return or_default(context.edge_fade, _EDGE_FADE * min(size))


def _grid(builder: NodeBuilder, name: str) -> Any:
    """The output socket of the value of a grid, or of an attribute of points."""
    attribute = builder.node("ShaderNodeAttribute")
    attribute.attribute_name = name
    return attribute.outputs[2]  # `Fac`, from 5.0 on `Factor`


def _box(context: LookContext) -> SmokeBox:
    assert context.smoke_box is not None, "looks of volumes are for volumes"
    return context.smoke_box
