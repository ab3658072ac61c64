"""A picture of embers by the real Cycles."""

import numpy as np
from blender_scenes import PIXELS_PER_METRE, RESOLUTION, draw_all, read, spec_of
from needed_blender import needs_bpy
from warm_python import run_python

from render.parameters import MaterialParameters
from render.point_clouds import PointCloud, read_point_cloud, write_point_cloud
from render.spec import PointSequenceObject

pytestmark = needs_bpy

DRAW_EXPORTED = """
import sys
from pathlib import Path
import bpy
from blender_scripts.scene_file import SceneFile
folder = Path(sys.argv[1])
SceneFile(folder / "spec.json", threads=1, gpu=None).save_blend([0], folder / "scene.blend")
bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
render = bpy.context.scene.render
render.image_settings.file_format, render.filepath = "PNG", str(folder / "exported.png")
bpy.ops.render.render(write_still=True)
"""


def test_the_hotter_they_are_the_brighter_they_glow_and_cold_ones_are_black_in_an_exported_scene_too(tmp_path):
    places = np.array([(-0.5, 0.0, 0.5), (0.0, 0.0, 0.5), (0.5, 0.0, 0.5)], np.float32)
    kelvin = np.array([1400.0, 1150.0, 800.0], np.float32)
    rest = np.zeros_like(places), np.full(3, 0.15, np.float32), np.ones(3, np.float32), np.zeros(3, np.uint8)
    file = tmp_path / "embers" / "000000.ply"
    file.parent.mkdir()
    write_point_cloud(file, PointCloud(places, *rest, temperature=kelvin))
    assert read_point_cloud(file).temperature.tolist() == kelvin.tolist()
    look = MaterialParameters(look="embers", emission=0.3)
    spec = spec_of(
        PointSequenceObject(name="sparks", file="embers/{frame}.ply", kind="spray", material=look), samples=8
    )
    drawn = draw_all(tmp_path, spec, range(1))
    run_python(DRAW_EXPORTED, str(tmp_path))
    columns = (0.5 * RESOLUTION[0] + PIXELS_PER_METRE * places[:, 0]).astype(int)
    for picture in (*drawn, read(tmp_path / "exported.png")):
        red, green, blue = picture[RESOLUTION[1] // 2, columns].T
        assert 250 > red[0] > 2 * red[1] > 2 * red[2]
        assert red[2] < 5
        assert red[0] > green[0] > blue[0]
