"""Volumes filled with particles at the start, as a job file names them, and the dye in them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Protocol

from pydantic import AfterValidator, Field, ValidationInfo

from sim.core.parameters import Fraction, Vector3
from sim.shapes.group_parameters import GroupedPlacement
from sim.shapes.groups import Taken, members

DYE = "Concentration of dye, from 0 to 1 [-], which has the colour dye_color of the body's material,"


class BlockParameters(GroupedPlacement):
    """A volume filled at the start, or with `count` many of them."""

    velocity: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Initial velocity [m/s].")
    dye: Fraction = Field(default=0.0, description=f"{DYE} at the start.")


def _with_groups(tables: tuple[BlockParameters, ...], told: ValidationInfo) -> tuple[BlockParameters, ...]:
    """All blocks of the tables of a body: those of a group in place of its table. What are blocks already stay so.

    Raises:
        KeyRefusedError: those of a group have no room.
    """
    blocks: list[BlockParameters] = []
    scattered = Taken()
    for number, table in enumerate(tables):
        if table.is_placed or table.count is None:
            blocks.append(table if table.is_placed else table.placed(number))
            continue
        name = f"{told.data.get('name', '')} {number}"
        blocks += [table.placed(number, **placing) for placing in members(table, number, name, scattered)]
    return tuple(blocks)


Blocks = Annotated[tuple[BlockParameters, ...], AfterValidator(_with_groups)]
"""Blocks of a body whose `name` stands before them."""


class _Dyed(Protocol):
    @property
    def dye(self) -> float: ...


def dye_conflict(sources: Iterable[_Dyed]) -> str | None:
    """Why the dye of what mixes, blocks and emitters, can do nothing."""
    dyes = {each.dye for each in sources}
    if len(dyes) != 1 or dyes == {0.0}:
        return None
    return (
        f"has a dye of {max(dyes):g} everywhere, and nothing to mix with; give a block or an emitter another one, or "
        "remove dye and name the color of its material"
    )
