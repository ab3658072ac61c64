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


def reach_of_motion() -> float:
    """Time before and after a frame that Cycles samples motion in [frames]: for blur, or vectors to other frames."""
    scene = bpy.context.scene
    if bpy.context.view_layer.use_pass_vector:
        return 1.0
    return 0.5 * scene.render.motion_blur_shutter if scene.render.use_motion_blur else 0.0
