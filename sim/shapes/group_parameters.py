"""How many bodies or blocks one table makes, and where: `count` in a job file, and what is beside it."""

from __future__ import annotations

from math import prod
from typing import Annotated, Any, Self

from pydantic import Field, PrivateAttr, model_validator

from sim.core.parameters import KeyRefusedError, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import BoxShape, CapsuleShape, CylinderShape, Placement, SphereShape, TorusShape

MOST_OF_A_GROUP = 100_000
PLACES = ("spacing", "along", "scatter")
"""Keys of which a group has one: they say where its members are."""

Count = Annotated[int, Field(ge=1, le=MOST_OF_A_GROUP)]
NonNegativeVector3 = tuple[NonNegative, NonNegative, NonNegative]

Room = Annotated[
    BoxShape | SphereShape | CylinderShape | CapsuleShape | TorusShape,
    Field(discriminator="type"),
]


class JitterParameters(Parameters):
    """How much the bodies of a group are out of line: each by a random part of it, to either side."""

    position: NonNegativeVector3 = Field(default=(0.0, 0.0, 0.0), description="Most along the world's x, y, z [m].")
    rotation_deg: NonNegativeVector3 = Field(
        default=(0.0, 0.0, 0.0), description="Most about the body's own x, then y, then z [degrees]."
    )


class ScatterParameters(Parameters):
    """A shape that bodies are scattered in, where no two of them touch; its centre and turn are the table's."""

    shape: Room = Field(
        description="The shape: a box, sphere, cylinder, capsule or torus. Each body gets a ball of room in it."
    )
    gap: NonNegative = Field(default=0.0, description="Least distance between the balls around two bodies [m].")
    turned: bool = Field(default=True, description="Whether each body is turned in a random direction.")


class CurveParameters(Parameters):
    """A smooth curve through points that the centres of bodies lie on, equally far apart."""

    points: Annotated[tuple[Vector3, ...], Field(min_length=2, max_length=400)] = Field(
        description="Points that it goes through, from the table's position [m]."
    )
    closed: bool = Field(default=False, description="Whether it returns to its first point.")
    turned: bool = Field(
        default=True, description="Whether each body is turned about z, so that its own x axis points along the curve."
    )


class GroupedPlacement(Placement):
    """A shape in the world, or with `count` a group of such shapes."""

    # A group's keys are spent once its members are there, so that nothing of them is in what decides a frame.
    count: Count | tuple[Count, Count, Count] | None = Field(
        default=None,
        exclude=True,
        description="Makes a group of so many [-], bodies of which are named NAME_1, NAME_2, ...: one number, or those "
        "along x, y and z of a lattice, of which the first is at the position. The rotation turns the lattice, too.",
    )
    spacing: Positive | Vector3 | None = Field(
        default=None,
        exclude=True,
        description="Of a group: from one centre to the next [m], along x (one number, and one count), along x, y and "
        "z of a lattice, or three numbers for one count: the way from each one to the next.",
    )
    offset: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        exclude=True,
        description="How far every second storey of a lattice is shifted [m]: half a brick for a wall in bond.",
    )
    along: CurveParameters | None = Field(
        default=None, exclude=True, description="Instead of spacing: a curve that those of a group stand on."
    )
    scatter: ScatterParameters | None = Field(
        default=None,
        exclude=True,
        description="Instead of spacing: a shape that those of a group are scattered in, clear of each other and of "
        "other scattered bodies, or blocks of the same body.",
    )
    jitter: JitterParameters | None = Field(
        default=None, exclude=True, description="How much those of a group are out of line."
    )
    scales: tuple[Positive, Positive] | None = Field(
        default=None,
        exclude=True,
        description="Smallest and largest size of those of a group, times scale [-]: each has one of eight sizes "
        "between, by chance.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        exclude=True,
        description="Of a group: another number gives other places, turns and sizes where chance has a part in them.",
    )
    _table: int | None = PrivateAttr(default=None)
    _member: int | None = PrivateAttr(default=None)

    @property
    def is_placed(self) -> bool:
        """Whether it is one thing, not a table that may make many."""
        return self._table is not None

    @property
    def table(self) -> int:
        """Which of the tables of its list it comes from."""
        assert self._table is not None, "what a job has knows its table"
        return self._table

    @property
    def member(self) -> int | None:
        """Which of its group it is, from 1; None of what is of none."""
        return self._member

    @property
    def many(self) -> int:
        """How many the table makes."""
        if self.count is None:
            return 1
        return self.count if isinstance(self.count, int) else prod(self.count)

    def placed(self, table: int, *, member: int | None = None, **values: Any) -> Self:
        """One of a table of this number, with other values; which it is of a group, whose keys are spent then."""
        if member is None:
            one = self.model_copy(update=values)
        else:
            spent = dict.fromkeys(("count", "spacing", "along", "scatter", "jitter", "scales"))
            one = self.model_copy(update={**spent, "offset": (0.0, 0.0, 0.0), "seed": 0, **values})
            one._member = member
        one._table = table
        return one

    @model_validator(mode="after")
    def _has_one_way_to_be_many(self) -> Self:
        given = self.model_fields_set
        if self.count is None:
            for key in (*PLACES, "offset", "jitter", "scales", "seed"):
                if key in given:
                    raise KeyRefusedError((key,), "has no meaning for one body; add count, or remove it")
            return self
        if self.many > MOST_OF_A_GROUP:
            raise KeyRefusedError(("count",), f"is {self.many:,} bodies; a group has {MOST_OF_A_GROUP:,} at most")
        ways = [key for key in PLACES if getattr(self, key) is not None]
        if len(ways) != 1:
            what = f"{' and '.join(ways)} place the bodies" if ways else "nothing places the bodies"
            raise KeyRefusedError(("count",), f"{what}; give one of {', '.join(PLACES)}")
        is_lattice = not isinstance(self.count, int)
        if is_lattice and self.spacing is None:
            raise KeyRefusedError(("count",), f"of a lattice needs spacing; with {ways[0]} give one number")
        if "offset" in given and not is_lattice:
            raise KeyRefusedError(("offset",), "shifts storeys of a lattice; give three counts, or remove it")
        if self.scales is not None and self.scales[0] > self.scales[1]:
            raise KeyRefusedError(("scales",), f"has the smallest size first, got {self.scales[0]:g} before the other")
        return self
