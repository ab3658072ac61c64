"""Cloth as a job file names it, and its materials: defaults that keys of a job override."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.parameters import BodyName, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import MeshShape

Material = Literal["cotton", "silk", "denim", "rubber"]

RUBBER_MODULUS, RUBBER_POISSON, RUBBER_DENSITY, RUBBER_THICKNESS = 1.5e6, 0.5, 1000.0, 1.0e-3
"""Young's modulus [Pa], Poisson's ratio [-], density [kg/m³] and thickness [m] of a sheet of soft natural rubber (Gent
2012, "Engineering with Rubber", ch. 3: 1-2 MPa, incompressible, 910-1200 kg/m³ with fillers)."""

MATERIAL_UNITS: Mapping[str, str] = {
    "mass_per_area": "kg/m²",
    "stretch_stiffness": "N/m",
    "shear_stiffness": "N/m",
    "poisson_ratio": "-",
    "bend_stiffness": "N m",
    "thickness": "m",
    "friction": "-",
}
"""Keys that a material gives."""

_STIFFNESS = RUBBER_MODULUS * RUBBER_THICKNESS  # [N/m]

_NUMBERS: Mapping[Material, tuple[float, ...]] = {
    "cotton": (0.15, 4.0e3, 50.0, 0.0, 8.0e-6, 0.5e-3, 0.5),
    "silk": (0.07, 3.0e3, 20.0, 0.0, 2.5e-6, 0.2e-3, 0.25),
    "denim": (0.40, 10.0e3, 150.0, 0.0, 60.0e-6, 0.9e-3, 0.6),
    "rubber": (
        RUBBER_DENSITY * RUBBER_THICKNESS,
        _STIFFNESS,
        _STIFFNESS / (2.0 * (1.0 + RUBBER_POISSON)),
        RUBBER_POISSON,
        _STIFFNESS * RUBBER_THICKNESS**2 / (12.0 * (1.0 - RUBBER_POISSON**2)),
        RUBBER_THICKNESS,
        0.9,
    ),
}

MATERIALS: Mapping[Material, Mapping[str, float]] = {
    material: dict(zip(MATERIAL_UNITS, numbers, strict=True)) for material, numbers in _NUMBERS.items()
}
"""Mass per area [kg/m²], stretch and shear stiffness [N/m], Poisson's ratio [-], bending rigidity [N m], thickness [m],
friction [-].

Woven cloths lie within the ranges that Kawabata's instruments find at small loads (Kawabata 1980, "The standardization
and analysis of hand evaluation"; Hu 2004, "Structure and mechanics of woven fabrics", ch. 4-6). His units convert so:

- bending rigidity B: 1 gf cm²/cm = 98.1 uN m; cotton 0.05-0.1, silk 0.02-0.04, denim 0.4-1
- shear G: 1 gf/(cm deg) = 56 N/m; cotton 0.5-1.5, silk 0.3-0.5, denim 2-4
- tension: 500 gf/cm = 490 N/m at a strain of 3-15 %, as yarns straighten before they stretch: 3 to 16 kN/m

Rubber is an isotropic elastic sheet: stretch E h, shear E h / (2 (1 + nu)), bending E h³ / (12 (1 - nu²)).
"""

_WOVEN = "within Kawabata's ranges at small loads (Kawabata 1980; Hu 2004, ch. 4-6)"

SOURCES: Mapping[Material, str] = {
    "cotton": f"a shirting of plain cotton, {_WOVEN}",
    "silk": f"a light habotai, {_WOVEN}",
    "denim": f"12 oz, {_WOVEN}",
    "rubber": "1 mm of soft natural rubber of 1.5 MPa, incompressible, an isotropic elastic sheet (Gent 2012, ch. 3)",
}
"""What each is, and where its numbers are from, for people."""


Corner = Literal["x-y-", "x+y-", "x-y+", "x+y+"]
Edge = Literal["x-", "x+", "y-", "y+"]

DEFAULT_SUBSTEPS = 20  # steps per frame of XPBD where none are asked for: 0.8 ms at 60 frames a second
MOST_REFINED = 16  # into so many parts those are divided at most

MOST_SWEEPS, MOST_TURNS = 8, 4
"""Sweeps over the springs in a step, at most, where neither `iterations` nor `substeps` are asked for; and how often
springs and contacts then take turns."""

RUNAWAY_SPEED = 1.0e4  # no cloth of a film moves at thirty times the speed of sound [m/s]


class RectangleSheet(Parameters):
    """A flat rectangle in its own x-y plane, centred on the origin; corners and edges are named after its axes."""

    type: Literal["rectangle"]
    size: tuple[Positive, Positive] = Field(description="Lengths along x and y [m].")
    counts: tuple[Annotated[int, Field(ge=2, le=4096)], Annotated[int, Field(ge=2, le=4096)]] | None = Field(
        default=None, description="Nodes along x and y [-]; give these or resolution."
    )
    resolution: Positive | None = Field(
        default=None, description="Distance between nodes, about [m]; the sides are divided evenly."
    )

    @property
    def node_counts(self) -> tuple[int, int]:
        """Nodes along x and y."""
        if self.counts is not None:
            return self.counts
        assert self.resolution is not None
        # Far beyond what is allowed, as a side over the smallest numbers is no number any more.
        along_x, along_y = (max(2, round(min(side / self.resolution, 1.0e9)) + 1) for side in self.size)
        return along_x, along_y

    @model_validator(mode="after")
    def _is_divided_once(self) -> Self:
        if (self.counts is None) == (self.resolution is None):
            raise ValueError("give counts or resolution, one of them")
        if self.resolution is not None and max(self.node_counts) > 4096:
            raise ValueError(
                f"resolution of {self.resolution:g} m makes {max(self.node_counts)} nodes on a side, 4096 at most"
            )
        return self


Sheet = Annotated[RectangleSheet | MeshShape, Field(discriminator="type")]


class BoxRegion(Parameters):
    """An axis-aligned box of the world."""

    type: Literal["box"]
    min: Vector3 = Field(description="Lower corner [m].")
    max: Vector3 = Field(description="Upper corner [m].")

    @model_validator(mode="after")
    def _has_its_corners_in_order(self) -> Self:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low > high:
                raise ValueError(f"max must not be below min along {axis}, got {low:g} m to {high:g} m; swap them")
        return self


class SphereRegion(Parameters):
    """A ball of the world."""

    type: Literal["sphere"]
    position: Vector3 = Field(description="Centre [m].")
    radius: Positive = Field(description="Radius [m].")


class PinKeyframeParameters(Parameters):
    """How far a pin has been moved at one time."""

    time_s: NonNegative = Field(description="Time [s]; later than that of the keyframe before.")
    offset: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Way from where the pin started [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Rotation of the pinned points about their centre, about x, then y, then z (world axes) [degrees].",
    )


class PinParameters(Parameters):
    """Nodes that are held: at rest, or moved along a path; for ever, or until they are let go."""

    corner: Corner | None = Field(default=None, description="A corner of a rectangle, in its own axes.")
    edge: Edge | None = Field(default=None, description="An edge of a rectangle, in its own axes.")
    index: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        default=None,
        min_length=1,
        description="Numbers of nodes, from 0: of a rectangle along x first; of a mesh its vertices as the file counts "
        "them, v lines of an OBJ whatever its seams and objects.",
    )
    region: Annotated[BoxRegion | SphereRegion, Field(discriminator="type")] | None = Field(
        default=None, description="All nodes that start in a box or a ball of the world."
    )
    keyframe: tuple[PinKeyframeParameters, ...] = Field(
        default=(),
        description="Path of the pin, the first keyframe where it starts; it rests before the first and after the last "
        "keyframe.",
    )
    interpolation: Literal["cubic", "linear"] = Field(
        default="cubic",
        description="Between keyframes. cubic: velocities are continuous; linear: they are constant and jump.",
    )
    release_s: Positive | None = Field(default=None, description="When it lets go [s]; never if omitted.")

    @model_validator(mode="after")
    def _names_one_place(self) -> Self:
        given = [key for key in ("corner", "edge", "index", "region") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of corner, edge, index and region, got {' and '.join(given) or 'none'}")
        for number, (before, after) in enumerate(pairwise(self.keyframe), start=1):
            if after.time_s <= before.time_s:
                raise ValueError(
                    f"keyframe[{number}].time_s must be after {before.time_s:g} s, that of the keyframe before, "
                    f"got {after.time_s:g} s"
                )
        if self.keyframe and any((*self.keyframe[0].offset, *self.keyframe[0].rotation_deg)):
            raise ValueError(
                f"keyframe[0] is where the pin starts, so its offset and rotation_deg must be zero, got "
                f"{_written(self.keyframe[0].offset)} m and {_written(self.keyframe[0].rotation_deg)} degrees; move or "
                "turn the cloth itself, or add a keyframe without them before it"
            )
        if len(self.keyframe) == 1:
            raise ValueError("keyframe: a path needs two keyframes at least; add one, or remove it")
        if self.keyframe and self.release_s is not None and self.release_s <= self.keyframe[0].time_s:
            raise ValueError(
                f"release_s is {self.release_s:g} s, before its path starts at {self.keyframe[0].time_s:g} s: "
                "release it later, or remove its keyframes"
            )
        if "interpolation" in self.model_fields_set and not self.keyframe:
            raise ValueError("interpolation has no meaning without keyframes; remove it or add [[cloth.pin.keyframe]]")
        return self


class ClothParameters(Parameters):
    """A cloth: its sheet at rest, where it starts, what it is made of, what holds it, and its numerics.

    Stiffnesses are those of the sheet, per width, not of single springs: how finely the sheet is divided does not
    change them. `sim.cloth.springs` converts them.
    """

    name: BodyName = Field(description="Name of the cloth, unique in the job.")
    shape: Sheet = Field(description="The sheet without loads: a rectangle, or any triangle mesh.")
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="World position of the sheet's centre [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Rotation about x, then y, then z (world axes) [degrees]."
    )
    velocity: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Velocity at the start [m/s].")
    material: Material = Field(
        default="cotton", description="Where mass, stiffness, thickness and friction come from if they are omitted."
    )
    mass_per_area: Positive = Field(default=0.15, description="Mass per area [kg/m²]; the material's if omitted.")
    stretch_stiffness: Positive = Field(
        default=4.0e3,
        description="Tension per width over strain, along warp or weft [N/m]: Young's modulus times thickness; the "
        "material's if omitted. They run along x and y of a rectangle, and as most of the border of a mesh.",
    )
    shear_stiffness: NonNegative = Field(
        default=50.0,
        description="Shear force per width over the angle between warp and weft [N/m]; the material's if omitted.",
    )
    poisson_ratio: Annotated[float, Field(ge=0.0, le=0.9)] = Field(
        default=0.0,
        description="Contraction across over strain, of a strip along warp or weft [-]; the material's if omitted.",
    )
    bend_stiffness: NonNegative = Field(
        default=8.0e-6,
        description="Bending rigidity: moment per width over curvature [N m]; the material's if omitted.",
    )
    damping: NonNegative = Field(
        default=0.0,
        description="Time in which a stretched or sheared cloth alone creeps back (Kelvin-Voigt) [s]: the damping of a "
        "spring is so many times its stiffness. xpbd damps such motion by itself.",
    )
    bend_damping: NonNegative = Field(default=1.0e-2, description="Likewise, of bending [s].")
    thickness: Positive = Field(
        default=0.5e-3, description="Distance that its layers keep from each other [m]; the material's if omitted."
    )
    friction: NonNegative = Field(
        default=0.5,
        description="Coulomb friction [-]; a pair of bodies has the geometric mean of its two. "
        "The material's if omitted.",
    )
    self_collision: bool = Field(default=True, description="Whether it collides with itself.")
    wind: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Velocity of the air [m/s]; in the box of a smoke the smoke's air blows instead.",
    )
    air_density: NonNegative = Field(default=1.2, description="Density of the air [kg/m³]; 0 for a vacuum.")
    drag: NonNegative = Field(
        default=1.2, description="Drag coefficient of air that blows against it [-]; 1.2 of a square plate."
    )
    skin_drag: NonNegative = Field(
        default=0.02, description="Drag coefficient of air that blows along it, both sides together [-]."
    )
    pin: tuple[PinParameters, ...] = Field(default=(), description="What is held.")
    integrator: Literal["xpbd", "explicit"] = Field(
        default="xpbd",
        description="xpbd: compliant springs with small steps (Macklin et al. 2019), stable at any stiffness; "
        "explicit: symplectic Euler, the reference, whose step the stiffest spring limits.",
    )
    substeps: Annotated[int, Field(ge=1, le=100_000)] | None = Field(
        default=None,
        description=f"Steps per frame [-]; if omitted {DEFAULT_SUBSTEPS}, and up to {MOST_REFINED} times as many while "
        "springs are longer than their tension makes them; for explicit as many as it takes to keep the energy. Cloths "
        "of a job take the same steps, as many as the one with the most asks for, or those that omit it need.",
    )
    iterations: Annotated[int, Field(ge=1, le=100)] | None = Field(
        default=None,
        description="Sweeps of xpbd over its springs in every step, before contacts [-]; if omitted 1 where substeps "
        f"are given, else as many as it takes for no spring to be longer than its tension makes it, up to "
        f"{MOST_SWEEPS}; springs and contacts then take up to {MOST_TURNS} turns more where these leave any too long. "
        "A sweep does not let every spring of a rectangle know of all that hangs on it: one that hangs from single "
        "points stretches too much there, by less with each sweep and with the square of the step; a run warns of "
        "springs that get half too long by it. Each cloth has its own.",
    )

    @model_validator(mode="before")
    @classmethod
    def _take_material(cls, data: Any) -> Any:
        """What is omitted comes from the material."""
        material = data.get("material", "cotton") if isinstance(data, dict) else None
        if not isinstance(material, str) or material not in MATERIALS:
            return data  # the field's own validation says what is wrong with it
        return {**MATERIALS[material], **data}

    @property
    def plane_stiffness(self) -> float:
        """Tension per width over strain along warp or weft of a sheet that cannot contract across [N/m]."""
        return self.stretch_stiffness / (1.0 - self.poisson_ratio**2)

    @model_validator(mode="after")
    def _fits_its_sheet(self) -> Self:
        if self.integrator == "explicit" and self.iterations is not None:
            raise ValueError(f'iterations = {self.iterations} has no meaning for integrator = "explicit"; remove it')
        for number, pin in enumerate(self.pin):
            for key in ("corner", "edge"):
                if getattr(pin, key) is not None and not isinstance(self.shape, RectangleSheet):
                    raise ValueError(f"pin[{number}].{key} is for rectangles; pin a mesh by index or region")
        return self


def shared_conflicts(cloths: tuple[ClothParameters, ...]) -> list[tuple[int, str, str]]:
    """Why cloths cannot step together: number of the cloth, its key, and a sentence, for each reason."""
    first = cloths[0] if cloths else None
    return [
        (
            number,
            "integrator",
            f'is "{cloth.integrator}", but "{first.integrator}" in cloth[0] "{first.name}"; all cloths share it',
        )
        for number, cloth in enumerate(cloths)
        if first and cloth.integrator != first.integrator
    ]


def substeps_of(cloths: Sequence[ClothParameters]) -> int:
    """Steps a frame that cloths of XPBD take together, where none are refined: what the one with the most asks for."""
    return max((cloth.substeps or DEFAULT_SUBSTEPS for cloth in cloths), default=DEFAULT_SUBSTEPS)


THINNEST_AIR = 1.0e-3
"""Least density of air that cloth and smoke share [kg/m³]: thinner air would be thrown about faster than sums hold."""


def conflict_in_one_air(cloths: Sequence[ClothParameters]) -> tuple[tuple[str | int, ...], str] | None:
    """The key, from the scene, by which a cloth cannot hang in the air of a smoke, and why; cloths may have none."""
    in_air = [(index, cloth) for index, cloth in enumerate(cloths) if cloth.air_density > 0.0]
    for index, cloth in in_air:
        path, said = ("cloth", index, "air_density"), f'is {cloth.air_density:g} kg/m³ for "{cloth.name}"'
        first = in_air[0][1]
        if cloth.air_density < THINNEST_AIR:
            return path, f"{said}; beside smoke it must be 0, or {THINNEST_AIR:g} kg/m³ at least"
        if cloth.air_density != first.air_density:
            return (
                path,
                f'{said}, but {first.air_density:g} kg/m³ for "{first.name}"; smoke has one air: '
                "give them the same, or 0",
            )
    return None


def _written(value: object) -> str:
    return "omitted" if value is None else f'"{value}"' if isinstance(value, str) else f"{value}"
