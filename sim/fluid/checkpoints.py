"""What a checkpoint of a particle fluid holds, and whether arrays are one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim.core.solver import Arrays

CHECKPOINT_ARRAYS = {
    "position": ("float32", "vector"),
    "velocity": ("float32", "vector"),
    "particle_id": ("int32", "scalar"),
    "phase": ("int32", "scalar"),
    "reference_position": ("float32", "vector"),
    "travelled": ("float64", "number"),
    "boundary_travelled": ("float64", "number"),
    "boundary_speed": ("float64", "pair"),
    "body_states": ("float32", "bodies"),
    "reference_body_states": ("float32", "bodies"),
    "max_speed": ("float64", "number"),
    "max_acceleration": ("float64", "number"),
    "max_frequency": ("float64", "number"),
    "max_displacement": ("float64", "number"),
    "particles_removed": ("int64", "number"),
    "next_particle_id": ("int64", "number"),
}
"""Type of each array of a checkpoint, and whether it has a vector or scalar per particle, one number in all or two, or
the states of all moving bodies."""

SHEET_ARRAYS = ("sheet_position", "sheet_velocity", "reference_sheet_position", "sheet_force_0", "sheet_force_1")
"""What it holds besides where there are sheets, a vector for each of their samples."""


def check_checkpoint(
    arrays: Arrays,
    fluid: str,
    *,
    capacity: int,
    carried: tuple[str, ...],
    body_states: tuple[int, ...],
    sheet_samples: int = 0,
) -> None:
    """Raise ValueError for arrays that are no checkpoint of a particle fluid.

    Args:
        arrays: by name.
        fluid: its name.
        capacity: particles that it has room for.
        carried: scalars per particle that its solver keeps.
        body_states: shape of the states of its moving bodies.
        sheet_samples: number of samples of sheets.
    """
    expected = CHECKPOINT_ARRAYS | dict.fromkeys(carried, ("float32", "scalar"))
    if sheet_samples:
        expected |= dict.fromkeys(SHEET_ARRAYS, ("float32", "sheets"))
    missing = sorted(set(expected) - set(arrays))
    if missing:
        raise ValueError(f'not a checkpoint of "{fluid}": it lacks {", ".join(missing)}')
    count = len(arrays["particle_id"])
    if count > capacity:
        raise ValueError(f'the checkpoint has {count} particles, "{fluid}" has room for {capacity}')
    shapes = {
        "vector": (count, 3),
        "scalar": (count,),
        "number": (1,),
        "pair": (2,),
        "bodies": body_states,
        "sheets": (sheet_samples, 3),
    }
    for name, (dtype, width) in expected.items():
        found = arrays[name]
        if found.shape != shapes[width] or found.dtype != dtype:
            raise ValueError(
                f'checkpoint of "{fluid}": {name} must be {dtype} {shapes[width]}, got {found.dtype} {found.shape}'
            )
