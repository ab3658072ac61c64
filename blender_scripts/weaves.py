"""Looks of woven cloth: threads that cross over and under each other, on the sheet's coordinates at rest.

Warp threads run along t, weft threads along s; u = s / d and v = t / d count them, d being their distance. In a weave
of period n, warp thread i passes under weft thread j where a i + j is a multiple of n, and over all others. Its height
is a triangle wave that is cut off above,

    z = clamp(2 |(v + a i + n/2 - 1/2) mod n - n/2| - 1, -1, 1),

that of a weft thread the negative of the same with u and b j, where b solves a b = 1 (mod n).

A pattern that is finer than the pixels would beat against them (moiré), and its normals and colours, another in every
sample, would be noise that the denoiser takes for detail. So threads fade from RESOLVED to UNRESOLVED into what they
are on average: far away a woven cloth is a matt sheet of their mean colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from blender_scripts.geometry import REST_UV
from blender_scripts.shading import Color, LookContext, NodeBuilder, draws, or_default


@dataclass(frozen=True)
class Weave:
    """Appearance of a woven cloth.

    Attributes:
        period: of the pattern [threads].
        warp_step, weft_step: a and b: by how much the pattern moves from one thread to the next [threads].
        thread_spacing: [m].
        warp: colour of the warp threads, if the job gives none; the job's colours these.
        weft: colour of the weft threads; that of the warp if None.
        roughness: of the surface [-].
        specular: of the surface, 0.5 as glass [-]. Threads show all their sides at any angle, so less of a mirror than
            glass; at grazing angles a higher one would lay the lamps' white over a matt, dark cloth.
        anisotropy: how much highlights are drawn out across the warp [-].
        sheen: light that fibres on the surface scatter at grazing angles, in the threads' colour [-].
        translucency: share of the scattered light that goes through [-].
        unevenness: how much threads differ in brightness [-].
        gaps: how dark it is between threads [-], 0 black.
    """

    period: int
    warp_step: int
    weft_step: int
    thread_spacing: float
    warp: Color
    weft: Color | None
    roughness: float
    specular: float
    anisotropy: float
    sheen: float
    translucency: float
    unevenness: float
    gaps: float


COTTON = Weave(2, 1, 1, 0.5e-3, (0.72, 0.66, 0.56), None, 0.85, 0.1, 0.0, 0.5, 0.25, 0.10, 0.45)
"""Plain weave of a shirting, some 20 threads a centimetre."""
SILK = Weave(5, 2, -2, 0.15e-3, (0.42, 0.02, 0.035), None, 0.38, 0.5, 0.6, 0.25, 0.2, 0.04, 0.8)
"""Five-end satin: long floats of fine threads, which shine across."""
DENIM = Weave(4, 1, 1, 0.8e-3, (0.012, 0.030, 0.100), (0.15, 0.16, 0.18), 0.9, 0.05, 0.0, 0.15, 0.0, 0.3, 0.4)
"""Twill of indigo warp over three, under one undyed weft; its back is mostly weft."""

RESOLVED, UNRESOLVED = 0.5, 1.0
"""Threads per pixel: up to the first, Nyquist's, threads are drawn as they are; from the second on there are none."""

_BOLT = 2000.0  # threads on both sides of the middle of the bolt that cloths are cut from

HALF_UNDULATION = 0.5  # how far a thread goes up and down, in its radii


def _build(builder: NodeBuilder, context: LookContext, weave: Weave) -> None:
    spacing = or_default(context.thread_spacing, weave.thread_spacing)
    # No two cloths come from the same place of a bolt; threads cross in the same way there.
    first = weave.period * round(_BOLT / weave.period * context.own_numbers(1)[0])
    u, v = _thread_numbers(builder, spacing, first)
    warp_height, weft_height = _heights(builder, weave, u, v)
    height = builder.math("MAXIMUM", warp_height, weft_height)
    shows_weft = builder.math("GREATER_THAN", weft_height, warp_height)
    detail = _detail(builder, context.pixel_angle / spacing)
    weft_share, brightness = mean_appearance(weave)
    shown_weft = _faded(builder, shows_weft, weft_share, detail)
    dyed = partial(context.own_shade, brightness=0.12, warmth=0.04)
    weft = None if weave.weft is None else dyed(weave.weft)
    color = _colors(builder, or_default(context.color, dyed(weave.warp)), weft, shown_weft)
    light = _faded(builder, _brightness(builder, weave, height, u, v), brightness, detail)
    color = builder.scaled(color, light)
    strength = builder.math("MULTIPLY", detail, 0.7)
    bump = builder.node("ShaderNodeBump", Distance=0.5 * spacing, Strength=strength, Height=height)
    shader = builder.node(
        "ShaderNodeBsdfPrincipled",
        Base_Color=color,
        Roughness=or_default(context.roughness, weave.roughness),
        Specular_IOR_Level=weave.specular,
        Anisotropic=weave.anisotropy,
        Sheen_Weight=weave.sheen,
        Sheen_Roughness=0.5,
        # Fibres are dyed as their threads are; white ones would make every dark cloth pale where light grazes it.
        Sheen_Tint=color,
        Normal=bump.outputs["Normal"],
    )
    if weave.anisotropy:
        tangent = builder.node("ShaderNodeTangent")
        tangent.direction_type, tangent.uv_map = "UV_MAP", REST_UV
        builder.link(tangent.outputs[0], shader.inputs["Tangent"])
    if weave.translucency:
        through = builder.node("ShaderNodeBsdfTranslucent", Color=color)
        shader = builder.mix_shaders(weave.translucency, shader, through)
    builder.surface(shader)


def mean_appearance(weave: Weave) -> tuple[float, float]:
    """Mean appearance of a weave over its period: share of weft on its front, and brightness of its threads.

    By 64 samples a thread, along and across; its unevenness has no mean effect.
    """
    place = (np.arange(weave.period * 64) + 0.5) / 64
    u, v = np.meshgrid(place, place, indexing="ij")

    def surface(along: np.ndarray, across: np.ndarray, step: int, sign: float) -> np.ndarray:
        from_dip = np.abs(
            (along + step * np.floor(across) + 0.5 * weave.period - 0.5) % weave.period - 0.5 * weave.period
        )
        undulation = sign * np.minimum(2.0 * from_dip - 1.0, 1.0)
        return np.abs(np.sin(np.pi * across)) + HALF_UNDULATION * undulation

    warp, weft = surface(v, u, weave.warp_step, 1.0), surface(u, v, weave.weft_step, -1.0)
    light = np.clip(weave.gaps + (1.0 - weave.gaps) * np.maximum(warp, weft), 0.0, 1.0)
    return float((weft > warp).mean()), float(light.mean())


def _detail(builder: NodeBuilder, threads_per_pixel_at_1_m: float) -> Any:
    """1 where threads are drawn, 0 where there are too many of them to a pixel.

    A pixel's footprint on the sheet is that of its angle at this distance, longer where the sheet is seen aslant.
    """
    geometry = builder.node("ShaderNodeNewGeometry").outputs
    facing = builder.vector_math("DOT_PRODUCT", geometry["Normal"], geometry["Incoming"])
    cosine = builder.math("MAXIMUM", builder.math("ABSOLUTE", facing), 1.0e-3)
    distance = builder.node("ShaderNodeCameraData").outputs["View Distance"]
    threads = builder.math("DIVIDE", builder.math("MULTIPLY", distance, threads_per_pixel_at_1_m), cosine)
    return builder.smoothstep(threads, RESOLVED, UNRESOLVED, start=1.0, end=0.0)


def _faded(builder: NodeBuilder, value: Any, mean: float, detail: Any) -> Any:
    """The value where detail is 1, its mean where it is 0."""
    return builder.math("MULTIPLY_ADD", builder.math("SUBTRACT", value, mean), detail, mean)


def _thread_numbers(builder: NodeBuilder, spacing: float, first: float = 0.0) -> tuple[Any, Any]:
    """u and v: where a point is, counted in threads of the bolt, of which `first` is the sheet's first."""
    coordinates = builder.node("ShaderNodeUVMap")
    coordinates.uv_map = REST_UV
    s, t, _ = builder.split(coordinates.outputs[0])
    u, v = (builder.math("MULTIPLY_ADD", each, 1.0 / spacing, first) for each in (s, t))
    return u, v


def _heights(builder: NodeBuilder, weave: Weave, u: Any, v: Any) -> tuple[Any, Any]:
    """Heights of the warp's and the weft's surface in thread radii: round threads that go up and down."""
    warp = _undulation(builder, weave.period, v, u, weave.warp_step)
    weft = builder.math("MULTIPLY", _undulation(builder, weave.period, u, v, weave.weft_step), -1.0)
    return _round(builder, u, warp), _round(builder, v, weft)


def _undulation(builder: NodeBuilder, period: int, along: Any, across: Any, step: int) -> Any:
    """z of the module's docstring."""
    thread = builder.math("MULTIPLY", builder.math("FLOOR", across), step)
    place = builder.math("ADD", builder.math("ADD", along, thread), 0.5 * period - 0.5)
    from_dip = builder.math(
        "ABSOLUTE", builder.math("SUBTRACT", builder.math("FLOORED_MODULO", place, period), 0.5 * period)
    )
    wave = builder.math("SUBTRACT", builder.math("MULTIPLY", from_dip, 2.0), 1.0)
    return builder.math("MINIMUM", wave, 1.0)


def _round(builder: NodeBuilder, across: Any, undulation: Any) -> Any:
    """A thread's surface, |sin(pi x)| across it, on its undulation of half a radius."""
    profile = builder.math("ABSOLUTE", builder.math("SINE", builder.math("MULTIPLY", across, 3.14159265)))
    return builder.math("ADD", profile, builder.math("MULTIPLY", undulation, HALF_UNDULATION))


def _colors(builder: NodeBuilder, warp: Color, weft: Color | None, shows_weft: Any) -> Any:
    """Colour of the thread that is on top; seen from behind, that is the one that lies below here."""
    back = builder.node("ShaderNodeNewGeometry").outputs["Backfacing"]
    shown = builder.math("ABSOLUTE", builder.math("SUBTRACT", shows_weft, back))
    return builder.mix_colors(shown, warp, weft or warp)


def _brightness(builder: NodeBuilder, weave: Weave, height: Any, u: Any, v: Any) -> Any:
    """A factor on colours, which are uneven along threads and darker between them."""
    # Thick and thin places of a thread are some forty spacings long.
    uneven = builder.math("ADD", _streaks(builder, u, 1.0, v, 0.025), _streaks(builder, u, 0.025, v, 1.0))
    uneven = builder.math("MULTIPLY_ADD", builder.math("SUBTRACT", uneven, 1.0), 2.0 * weave.unevenness, 1.0)
    light = builder.math("MINIMUM", builder.math("MULTIPLY_ADD", height, 1.0 - weave.gaps, weave.gaps), 1.0)
    return builder.math("MULTIPLY", uneven, builder.math("MAXIMUM", light, 0.0))


def _streaks(builder: NodeBuilder, u: Any, u_scale: float, v: Any, v_scale: float) -> Any:
    """Noise [0, 1] about 0.5 that is drawn out along one direction of threads."""
    place = builder.combined(builder.math("MULTIPLY", u, u_scale), builder.math("MULTIPLY", v, v_scale))
    return builder.noise(place, Scale=0.7, Detail=2.0)


draws("cotton")(partial(_build, weave=COTTON))
draws("silk")(partial(_build, weave=SILK))
draws("denim")(partial(_build, weave=DENIM))
