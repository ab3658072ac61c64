"""Smoke: OpenVDB files into Blender, one a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from blender_scripts.errors import RenderInputError


def new_volume_object(name: str) -> Any:
    """A volume object without a file yet, linked into the scene. Its velocities are in m/s."""
    volume = bpy.data.volumes.new(name)
    # With 'FRAME', the default, the shutter time would be ignored.
    volume.velocity_unit = "SECOND"
    volume.render.space = "OBJECT"
    blender_object = bpy.data.objects.new(name, volume)
    bpy.context.scene.collection.objects.link(blender_object)
    return blender_object


def load_volume(volume: Any, path: Path) -> None:
    """Point a volume at this frame's file and check that it can be read.

    Blender renders a missing or damaged VDB as empty space without a word, so it is loaded here first.

    Raises:
        RenderInputError: the file is missing, unreadable, or has no `density` grid.
    """
    if not path.is_file():
        raise RenderInputError(f"the volume {path} does not exist")
    volume.filepath = str(path)
    if not volume.grids.load():
        # Blender reports a damaged file once more for the file after it: only a second refusal counts.
        volume.grids.unload()
    if not volume.grids.load():
        raise RenderInputError(f"cannot read the volume {path}: {volume.grids.error_message or 'not an OpenVDB file'}")
    names = [grid.name for grid in volume.grids]
    if "density" not in names:
        raise RenderInputError(f"the volume {path} has no grid named density, only {names}")
    if "velocity" in names:
        # Blender checks the name against the loaded grids, so this comes after loading.
        volume.velocity_grid = "velocity"
