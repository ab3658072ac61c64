"""Materials of bodies for which the job file names none."""

from __future__ import annotations

from render.parameters import MaterialParameters
from sim.cloth.materials import Material

BODY = "body"
"""The part of a shape that carries the body's own name."""

_EYES = MaterialParameters(look="plastic", color=(0.01, 0.01, 0.012), roughness=0.08)

NATURAL_MATERIALS: dict[str, dict[str, MaterialParameters]] = {
    "duck": {
        BODY: MaterialParameters(look="rubber", color=(0.95, 0.55, 0.03)),
        "bill": MaterialParameters(look="rubber", color=(0.85, 0.16, 0.01)),
        "eyes": _EYES,
    },
    "bunny": {
        BODY: MaterialParameters(look="ceramic", color=(0.52, 0.39, 0.28)),
        "tail": MaterialParameters(look="ceramic", color=(0.85, 0.82, 0.76)),
        "eyes": _EYES,
        "nose": MaterialParameters(look="ceramic", color=(0.75, 0.25, 0.28)),
    },
}
"""Materials by shape and part. A shape that is not here has one part."""

WHITEWATER = {part: MaterialParameters(look=part) for part in ("spray", "foam", "bubbles")}
"""Materials of the parts of a fluid that has whitewater; each is a look of its own."""

CLOTHS: dict[Material, MaterialParameters] = {
    "cotton": MaterialParameters(look="cotton"),
    "silk": MaterialParameters(look="silk"),
    "denim": MaterialParameters(look="denim"),
    "rubber": MaterialParameters(look="rubber", color=(0.03, 0.03, 0.035)),
}
"""Materials of cloths, by what they are made of."""

GLOWING_K = 900.0
"""From here on the glow of smoke shows beside other light; by day it takes 1200 K and more [K]."""

FLUID = MaterialParameters(look="water")
SMOKE = MaterialParameters(look="smoke")
SOLID = MaterialParameters(look="plastic")


def parts_of(shape_type: str) -> tuple[str, ...]:
    """Names of a shape's parts, the body first."""
    return tuple(NATURAL_MATERIALS.get(shape_type, {BODY: SOLID}))
