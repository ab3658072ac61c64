"""Groups of rigid bodies: many of one table, with names, and the pieces of those that break."""

from __future__ import annotations

from collections.abc import Iterator

from sim.core.parameters import LONGEST_NAME_LETTERS, KeyRefusedError
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.groups import Taken, members


def with_groups(tables: tuple[RigidBodyParameters, ...]) -> tuple[RigidBodyParameters, ...]:
    """All bodies of a job's tables: those of a group in place of its table, named `NAME_1`, `NAME_2` and so on.

    Each knows the place of its table. Bodies that break are there as their pieces. What are bodies already stays as it
    is.

    Raises:
        KeyRefusedError: the bodies of a group have no room, or no names.
    """
    bodies: list[RigidBodyParameters] = []
    scattered = Taken()
    for number, table in enumerate(tables):
        if table.is_placed:
            bodies.append(table)
            continue
        for body in [table.placed(number)] if table.count is None else _named(table, number, scattered):
            bodies.extend(body.broken_down())
    return tuple(bodies)


def _named(table: RigidBodyParameters, number: int, scattered: Taken) -> Iterator[RigidBodyParameters]:
    if len(table.name) + 1 + len(str(table.many)) > LONGEST_NAME_LETTERS:
        raise KeyRefusedError((number, "name"), f'is too long for bodies named up to "{table.name}_{table.many}"')
    models: dict[float, str] = {}
    for placing in members(table, number, table.name, scattered):
        name = f"{table.name}_{placing['member']}"
        yield table.placed(number, name=name, model=models.setdefault(placing["scale"], name), **placing)
