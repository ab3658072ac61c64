"""Paths of pins that move."""

from __future__ import annotations

import numpy as np

from sim.cloth.parameters import PinParameters
from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath


def path_of_pin(pin: PinParameters) -> KeyframePath:
    """Offset and rotation of a pin that has keyframes, by time."""
    return KeyframePath(
        [keyframe.time_s for keyframe in pin.keyframe],
        np.array([keyframe.offset for keyframe in pin.keyframe], dtype=np.float64),
        np.stack([rotation.from_degrees(keyframe.rotation_deg) for keyframe in pin.keyframe]),
        linear=pin.interpolation == "linear",
    )
