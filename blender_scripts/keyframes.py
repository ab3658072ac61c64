"""Keyframes that hold for one frame only."""

from __future__ import annotations

from typing import Any

import bpy


def forget_keyframes(animated: Any) -> None:
    """Remove the animation of an object, or of an object's data."""
    if animated.animation_data is not None:
        action = animated.animation_data.action
        animated.animation_data_clear()
        if action is not None:  # an object and its data may share one
            bpy.data.actions.remove(action)
