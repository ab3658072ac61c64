"""The differences between Blender 4.5 LTS, 5.0 and 5.2 LTS that these scripts meet, all in one place.

Node sockets that were renamed in 5.0 (`Fac` became `Factor`) are addressed by index where they are used, which needs
no case distinction.
"""

from __future__ import annotations

from typing import Any

import bpy

MINIMUM_VERSION = (4, 5)


def blender_version() -> str:
    """Version of the running Blender, e.g. `5.0.1`."""
    return ".".join(str(part) for part in bpy.app.version)


def require_supported_version() -> None:
    """Raise RuntimeError when this Blender is older than the scripts support."""
    if tuple(bpy.app.version[:2]) < MINIMUM_VERSION:
        needed = ".".join(str(part) for part in MINIMUM_VERSION)
        raise RuntimeError(f"Blender {blender_version()} is too old; {needed} LTS or newer is needed")


def set_file_format(image_settings: Any, file_format: str) -> None:
    """Choose a file format: since 5.0 the kind of medium comes first, and layers would go to parts of their own.

    In one part they are as earlier versions and most other programs have them.
    """
    if hasattr(image_settings, "media_type"):
        image_settings.media_type = "MULTI_LAYER_IMAGE" if file_format == "OPEN_EXR_MULTILAYER" else "IMAGE"
    image_settings.file_format = file_format
    if hasattr(image_settings, "use_exr_interleave"):
        image_settings.use_exr_interleave = True


def node_tree_of(owner: Any) -> Any:
    """The emptied node tree of a material or world. Before 5.0 nodes had to be switched on first."""
    if bpy.app.version < (5, 0, 0):
        owner.use_nodes = True
    owner.node_tree.nodes.clear()
    return owner.node_tree


def set_physical_sky(sky: Any, *, sun_elevation: float, sun_rotation: float) -> None:
    """Make a sky texture physically based, without its sun disc; the sun's angles are in radians."""
    # 5.0 replaced Nishita's model by one with multiple scattering.
    sky.sky_type = "MULTIPLE_SCATTERING" if bpy.app.version >= (5, 0, 0) else "NISHITA"
    sky.sun_disc = False
    sky.sun_elevation = sun_elevation
    sky.sun_rotation = sun_rotation
