"""Looks as other programs can show them: a colour and a few numbers, of a preview surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from render.parameters import Color, MaterialParameters


@dataclass(frozen=True)
class PreviewLook:
    """Inputs of a preview surface: its colour in linear Rec. 709, and its numbers by their names in USD."""

    color: Color
    numbers: Mapping[str, float]


def _clear(color: Color, ior: float) -> PreviewLook:
    return PreviewLook(color, {"roughness": 0.02, "opacity": 0.25, "ior": ior})


def _even(color: Color, roughness: float, **numbers: float) -> PreviewLook:
    return PreviewLook(color, {"roughness": roughness, **numbers})


_GREY = _even((0.5, 0.5, 0.5), 0.5)

_PREVIEWS: dict[str, PreviewLook] = {
    "water": _clear((0.62, 0.82, 0.9), 1.33),
    "honey": PreviewLook((0.8, 0.42, 0.05), {"roughness": 0.05, "opacity": 0.75, "ior": 1.49}),
    "wine": PreviewLook((0.35, 0.01, 0.03), {"roughness": 0.02, "opacity": 0.8, "ior": 1.343}),
    "oil": PreviewLook((0.8, 0.65, 0.08), {"roughness": 0.02, "opacity": 0.5, "ior": 1.469}),
    "coffee": _even((0.05, 0.02, 0.008), 0.02),
    "ink": _even((0.005, 0.01, 0.1), 0.02),
    "juice": _even((0.9, 0.42, 0.03), 0.06),
    "muddy_water": _even((0.32, 0.21, 0.12), 0.06),
    "milk": _even((0.94, 0.92, 0.86), 0.06),
    "glass": _clear((0.94, 0.97, 0.95), 1.5),
    "smoke": _even((0.75, 0.75, 0.75), 1.0),
    "fire": _even((1.0, 0.45, 0.1), 1.0),
    "embers": _even((1.0, 0.45, 0.1), 1.0),
    "rubber": _even((0.95, 0.56, 0.02), 0.42),
    "ceramic": _even((0.82, 0.79, 0.74), 0.35, clearcoat=0.6),
    "plastic": _even((0.62, 0.06, 0.05), 0.25),
    "metal": _even((0.62, 0.61, 0.60), 0.28, metallic=1.0),
    "stone": _even((0.32, 0.30, 0.28), 0.8),
    "wood": _even((0.33, 0.18, 0.08), 0.5),
    "sand": _even((0.56, 0.40, 0.24), 0.75),
    "snow": _even((0.93, 0.95, 0.98), 0.6),
    "jelly": PreviewLook((0.85, 0.06, 0.05), {"roughness": 0.06, "opacity": 0.5, "ior": 1.35}),
    "drops": _clear((1.0, 1.0, 1.0), 1.33),
    "spray": _even((0.96, 0.98, 1.0), 0.25),
    "foam": _even((0.93, 0.95, 0.96), 1.0),
    "bubbles": _clear((0.97, 0.985, 1.0), 1.0),
    "cotton": _even((0.75, 0.72, 0.66), 0.9),
    "silk": _even((0.5, 0.04, 0.06), 0.35),
    "denim": _even((0.05, 0.09, 0.2), 0.9),
}
"""By look, near what Blender draws of it; pictures and textures are left out."""


def preview_of(material: MaterialParameters) -> PreviewLook:
    """The preview of a material; one of a .blend file is grey."""
    look = _PREVIEWS.get(material.look or "", _GREY)
    numbers = dict(look.numbers)
    if material.roughness is not None:
        numbers["roughness"] = material.roughness
    return replace(look, color=material.color or look.color, numbers=numbers)
