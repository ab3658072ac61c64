"""Materials of bodies for which the job file names none."""

from render.parameters import MaterialParameters

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

POINTS = {"drops": MaterialParameters(look="drops"), **WHITEWATER}
"""Materials of all parts of a clear fluid that are drawn as points."""

SOLID = MaterialParameters(look="plastic")


def parts_of(shape_type: str) -> tuple[str, ...]:
    """Names of a shape's parts, the body first."""
    return tuple(NATURAL_MATERIALS.get(shape_type, {BODY: SOLID}))
