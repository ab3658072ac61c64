"""Volumes alone in even light, as linear pixels: what pictures are compared with theory by."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from blender_scenes import spec_of
from warm_python import run_python

from render.parameters import MaterialParameters, VolumeParameters
from render.spec import VolumeSequenceObject
from render.volume import write_volume

AMBIENT_K = 293.0
PICTURE_WIDTH_M = 1.2
"""Of what the orthographic camera sees, around (0, 0, 0.5), looking along +y."""

DRAW = """
    import sys
    from pathlib import Path
    from unittest.mock import patch
    import bpy
    import numpy as np
    from blender_scripts import png, settings
    from blender_scripts.compatibility import node_tree_of
    from render.blender import open_renderer

    folder, frames, world_radiance, width, changes = sys.argv[1:]
    renderer = open_renderer(Path(folder) / "spec.json", threads=2, blender=None)
    scene = bpy.context.scene
    for each in list(bpy.data.objects):
        if each.type in ("LIGHT", "MESH"):
            bpy.data.objects.remove(each)
    tree = node_tree_of(scene.world)
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = float(world_radiance)
    tree.links.new(background.outputs[0], tree.nodes.new("ShaderNodeOutputWorld").inputs["Surface"])
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", float(width)
    image_settings = scene.render.image_settings
    image_settings.file_format, image_settings.color_mode, image_settings.color_depth = "OPEN_EXR", "RGB", "32"
    exec(changes)
    for frame in map(int, frames.split(",")):
        path = Path(folder) / f"{frame}.exr"
        with patch.object(settings, "choose_png"), patch.object(png, "strip_metadata"):
            renderer.render(frame, path)
        image = bpy.data.images.load(str(path))
        columns, rows = image.size
        np.save(path.with_suffix(".npy"), np.array(image.pixels[:], np.float32).reshape(rows, columns, -1)[::-1, :, :3])
"""


def write_frame(folder: Path, frame: int, density: np.ndarray, *, kelvin: float = AMBIENT_K, **changes: Any) -> None:
    """One frame of smoke whose box begins at (-0.3, -0.3, 0.2), of one temperature where there is smoke."""
    density = np.asarray(density, np.float32)
    arguments = {
        "temperature": np.where(density > 0, kelvin, AMBIENT_K),
        "velocity": np.zeros((*density.shape, 3), np.float32),
        "origin": (-0.3, -0.3, 0.2),
        "cell_size": 0.6 / density.shape[0],
        "ambient_temperature": AMBIENT_K,
        "parameters": VolumeParameters(),
        "fps": 60.0,
        "shutter": 0.5,
    }
    (folder / "smoke").mkdir(exist_ok=True)
    write_volume(folder / f"smoke/{frame:06d}.vdb", density=density, **(arguments | changes))


def smoke_object(material: MaterialParameters, *, open_faces: tuple[str, ...] = ()) -> VolumeSequenceObject:
    """The smoke of `write_frame`, in a box of 0.6 m."""
    return VolumeSequenceObject(
        name="smoke",
        file="smoke/{frame}.vdb",
        box_min=(-0.3, -0.3, 0.2),
        box_max=(0.3, 0.3, 0.8),
        open_faces=open_faces,
        ambient_temperature=AMBIENT_K,
        material=material,
    )


def draw_bare(
    folder: Path,
    smoke: VolumeSequenceObject,
    frames: int,
    *,
    world_radiance: float = 1.0,
    changes: str = "",
    width_m: float = PICTURE_WIDTH_M,
    **render: Any,
) -> list[np.ndarray]:
    """Linear pixels of frames 0 to `frames` - 1, (rows, columns, 3), of 64 x 64 unless told otherwise.

    Args:
        folder: with the frames of `write_frame`.
        smoke: the volume.
        frames: how many.
        world_radiance: of the even light from everywhere.
        changes: code for Blender, run before the first frame.
        width_m: what the picture is wide [m].
        render: parameters of the specification.
    """
    settings = {"resolution": (64, 64), "quality": "draft", "samples": 16, "motion_blur": False} | render
    spec_of(smoke, **settings).write(folder / "spec.json")
    numbers = ",".join(map(str, range(frames)))
    run_python(DRAW, str(folder), numbers, str(world_radiance), str(width_m), changes)
    return [np.load(folder / f"{frame}.npy") for frame in range(frames)]
