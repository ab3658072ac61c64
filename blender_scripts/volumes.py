"""Smoke: OpenVDB files into Blender, one a frame, and the lamps of fires."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from blender_scripts.errors import RenderInputError
from blender_scripts.flames import Glow, Lamp, lamps_of_file
from blender_scripts.geometry import new_object


def new_volume_object(name: str) -> Any:
    """A volume object without a file yet, linked into the scene. Its velocities are in m/s."""
    volume = bpy.data.volumes.new(name)
    # With 'FRAME', the default, the shutter time would be ignored.
    volume.velocity_unit = "SECOND"
    volume.render.space = "OBJECT"
    return new_object(name, volume)


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


def play(volume: Any, file: str, frames: Sequence[int]) -> None:
    """Let a volume play the files of frames; `file` has {frame} in it."""
    first, last = min(frames), max(frames)
    volume.filepath = file.replace("{frame}", f"{first:06d}")
    volume.is_sequence = True
    # Blender shows file number `frame - frame_start + 1 + frame_offset`.
    volume.frame_start, volume.frame_offset, volume.frame_duration = first, first - 1, last - first + 1


class FireLight:
    """The lamps of one fire, which shine as its volume glows, frame by frame."""

    def __init__(self, name: str, glow: Glow) -> None:
        self._name, self._glow = name, glow
        self.lamps: list[Any] = []

    def shine(self, path: Path) -> None:
        """Set the lamps to the light of this frame's volume.

        Raises:
            RenderInputError: the volume lacks a grid.
        """
        lamps = lamps_of_file(path, self._glow)
        while len(self.lamps) < len(lamps):
            self.lamps.append(self._new_lamp())
        for index, blender_object in enumerate(self.lamps):
            blender_object.hide_render = index >= len(lamps)
            if index < len(lamps):
                _set_lamp(blender_object, lamps[index])

    def _new_lamp(self) -> Any:
        blender_object = new_object(self._name, bpy.data.lights.new(self._name, "POINT"))
        # The eye and mirrors see the volume itself.
        blender_object.visible_camera = False
        blender_object.visible_glossy = False
        blender_object.visible_transmission = False
        return blender_object


def _set_lamp(blender_object: Any, lamp: Lamp) -> None:
    blender_object.location = lamp.position
    strongest = max(lamp.power)
    blender_object.data.energy = strongest
    blender_object.data.color = [channel / strongest for channel in lamp.power]
    blender_object.data.shadow_soft_size = lamp.radius
