"""The table of looks: the bodies a look is for, the material keys it uses, how it treats light.

A new look is one row here and one function with `@draws("its name")` in a module that `blender_scripts.looks` imports.
Job files, checks, fingerprints and Blender all read this table; it needs the standard library alone.
"""

from __future__ import annotations

from dataclasses import dataclass

SURFACES = ("rigid", "fluid", "cloth")
VOLUMES = ("smoke",)
EMBERS = ("embers",)
CLOTHS = ("cloth",)  # threads run along coordinates on the sheet at rest, which only cloths have
NOTHING: tuple[str, ...] = ()

MATERIAL_KEYS = (
    *("thread_spacing", "caustics", "roughness", "density", "anisotropy", "edge_fade"),
    *("emission", "flame_temperature", "dye_color"),
)
"""Keys of a material that have an effect on some looks, in the order that warnings of them have."""

VOLUME_KEYS = ("density", "anisotropy", "edge_fade")
FLAME_KEYS = ("emission", "flame_temperature")


@dataclass(frozen=True)
class LookRow:
    """Properties of a look beside its shader nodes.

    Attributes:
        bodies: kinds of bodies that a job file may give it to; empty: only Blender's scripts use it.
        keys: keys of a material that have an effect on it, beside `color`, which has one on every look.
        swims_on: kinds of these bodies that have nothing for its texture to hang on.
        paints_parts: parts of a body in this look keep their own materials; other looks are of one piece.
        fits_sheets: whether its texture is scaled by the size of a cloth.
        paves: whether the ground of a set can have it.
        lets_light_by: whether points of it are there for the eye alone, and lamps shine past them.
        revision: raised when the same keys give other pixels.
    """

    bodies: tuple[str, ...]
    keys: tuple[str, ...] = ()
    swims_on: tuple[str, ...] = ()
    paints_parts: bool = False
    fits_sheets: bool = False
    paves: bool = False
    lets_light_by: bool = False
    revision: int = 1

    @property
    def refracts(self) -> bool:
        """Whether it bends light that enters."""
        return "caustics" in self.keys

    @property
    def glows(self) -> bool:
        """Whether it shines by its own heat."""
        return "emission" in self.keys


LOOK_TABLE: dict[str, LookRow] = {
    "water": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color")),
    "honey": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color"), revision=2),
    "wine": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color")),
    "oil": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color")),
    "coffee": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color")),
    "ink": LookRow(SURFACES, ("roughness", "density", "caustics", "dye_color")),
    "milk": LookRow(SURFACES, ("roughness", "density", "dye_color")),
    "juice": LookRow(SURFACES, ("roughness", "density", "dye_color")),
    "muddy_water": LookRow(SURFACES, ("roughness", "density", "dye_color")),
    "smoke": LookRow(VOLUMES, VOLUME_KEYS),
    "fire": LookRow(VOLUMES, (*VOLUME_KEYS, *FLAME_KEYS)),
    "embers": LookRow(EMBERS, FLAME_KEYS),
    "rubber": LookRow(SURFACES, ("roughness", "dye_color"), paints_parts=True, paves=True),
    "ceramic": LookRow(SURFACES, ("roughness", "dye_color"), paints_parts=True, paves=True),
    "plastic": LookRow(SURFACES, ("roughness", "dye_color"), paints_parts=True, paves=True),
    "metal": LookRow(SURFACES, ("roughness",), paves=True, revision=2),
    "stone": LookRow(
        SURFACES, ("roughness", "dye_color"), swims_on=("fluid", "cloth"), fits_sheets=True, paves=True, revision=2
    ),
    "wood": LookRow(SURFACES, ("roughness",), swims_on=("fluid",), fits_sheets=True, paves=True, revision=2),
    "sand": LookRow(SURFACES, ("roughness", "dye_color"), revision=2),
    "snow": LookRow(SURFACES, ("roughness", "dye_color")),
    "jelly": LookRow(SURFACES, ("roughness", "dye_color")),
    "glass": LookRow(SURFACES, ("roughness", "caustics"), revision=2),
    "drops": LookRow(SURFACES, ("roughness", "dye_color"), lets_light_by=True, revision=3),
    "spray": LookRow(SURFACES, ("roughness",)),
    "foam": LookRow(SURFACES),
    "bubbles": LookRow(SURFACES, ("roughness",)),
    "cotton": LookRow(CLOTHS, ("roughness", "thread_spacing"), revision=3),
    "silk": LookRow(CLOTHS, ("roughness", "thread_spacing"), revision=3),
    "denim": LookRow(CLOTHS, ("roughness", "thread_spacing"), revision=3),
    "tank_glass": LookRow(NOTHING, ("roughness",)),
    "tank_edge": LookRow(NOTHING, ("roughness",)),
}
"""Every look, by its name in job files and specifications, in the order that lists of them have."""


def looks_for(body: str) -> tuple[str, ...]:
    """Names of the looks that a kind of body can have."""
    return tuple(name for name, row in LOOK_TABLE.items() if body in row.bodies)
