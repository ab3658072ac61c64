"""Materials of bodies for which the job file names none."""

from collections.abc import Mapping

from render.parameters import MaterialParameters
from sim.shapes.parameters import CompoundShape, PieceShape, Shape

BODY = "body"
"""The part of a shape that carries the body's own name."""

INSIDE = "inside"
"""The part of a piece that was inside of the whole."""

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


def natural_materials(shape: Shape) -> Mapping[str, MaterialParameters]:
    """Materials of a shape's parts, the body first, where the job file names none."""
    if isinstance(shape, CompoundShape):
        return dict.fromkeys((BODY, *(part.name for part in shape.part if part.name is not None)), SOLID)
    if isinstance(shape, PieceShape):
        return dict.fromkeys((BODY, INSIDE), SOLID)
    return NATURAL_MATERIALS.get(shape.type, {BODY: SOLID})


def parts_of(shape: Shape) -> tuple[str, ...]:
    """Names of a shape's parts, the body first."""
    return tuple(natural_materials(shape))
