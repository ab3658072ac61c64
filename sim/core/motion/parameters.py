"""Keyframes as a job file names them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from pydantic import Field

from sim.core.parameters import Fraction, NonNegative, Parameters, Vector3


class KeyframeParameters(Parameters):
    """Where something on a path is at one time."""

    time_s: NonNegative = Field(description="Time [s]; later than that of the keyframe before.")
    position: Vector3 = Field(description="Position of the centre in the world [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Rotation about x, then y, then z (world axes) [degrees]; "
        "the way from one keyframe to the next is the shortest, below 180 degrees.",
    )


class RampPointParameters(Parameters):
    """How strong something that emits, or a force, is at one time."""

    time_s: NonNegative = Field(description="Time [s]; later than that of the point before.")
    strength: Fraction = Field(
        description="Part of its full strength that it has then [-]: of density and heat of a source of smoke, of the "
        "speed of an emitter, of the force."
    )


def placed_at_first_keyframe(data: Any, what: str) -> Any:
    """Raw data of something with keyframes, `what` in messages, with the pose of the first as its place.

    Raises:
        ValueError: it is placed elsewhere as well.
    """
    if not isinstance(data, dict) or not isinstance(data.get("keyframe"), list | tuple) or not data["keyframe"]:
        return data
    first = data["keyframe"][0]
    if isinstance(first, KeyframeParameters):
        first = first.model_dump()
    if not isinstance(first, dict) or "position" not in first:
        return data  # the keyframe's own validation says what is wrong with it
    start = {key: first[key] for key in ("position", "rotation_deg") if key in first}
    for key in ("position", "rotation_deg"):
        if key not in data:
            continue
        there = start.get(key, (0.0, 0.0, 0.0))
        if not (isinstance(data[key], list | tuple) and isinstance(there, list | tuple)):
            return data  # its own validation, too
        if tuple(data[key]) != tuple(there):
            raise ValueError(f"{key} differs from that of the first keyframe, which places the {what}; remove {key}")
    return {**data, **start}


def require_ascending_times(
    points: Sequence[KeyframeParameters] | Sequence[RampPointParameters], key: str = "keyframe"
) -> None:
    """Raises ValueError unless each point under a key is later than the one before."""
    noun = "keyframe" if key == "keyframe" else "point"
    for number, (before, after) in enumerate(pairwise(points), start=1):
        if after.time_s <= before.time_s:
            raise ValueError(
                f"{key}[{number}].time_s must be after {before.time_s:g} s, that of the {noun} before, "
                f"got {after.time_s:g} s"
            )


def strength_at(ramp: Sequence[RampPointParameters], time_s: float) -> float:
    """Strength by a ramp at a time [s]: linear between its points, constant beyond them, 1 without any."""
    if not ramp:
        return 1.0
    return float(np.interp(time_s, [point.time_s for point in ramp], [point.strength for point in ramp]))
