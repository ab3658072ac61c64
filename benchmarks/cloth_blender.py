"""Blender's own cloth in the drop of `benchmarks.cloth`; prints JSON.

    python -m benchmarks.cloth_blender NODES FRAMES

Quality 5, collisions with the ball and the floor, and with itself at a distance of half the spacing of the nodes, as
there. Needs bpy in this Python.
"""

from __future__ import annotations

import json
import sys
import time

import bpy
import numpy as np

from benchmarks.cloth import BALL_HEIGHT, BALL_RADIUS, FLOOR, FRAMES_PER_SECOND, HEIGHT, SIDE, THICKNESS_IN_SPACINGS
from benchmarks.json_output import keep_output_for_json
from sim.cloth.parameters import RectangleSheet
from sim.cloth.sheet import rectangle


def main() -> None:
    keep_output_for_json()
    nodes, frames = int(sys.argv[1]), int(sys.argv[2])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.render.fps = round(FRAMES_PER_SECOND)
    sheet = rectangle(RectangleSheet(type="rectangle", size=(SIDE, SIDE), counts=(nodes, nodes)))
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata(sheet.vertices + (0.0, 0.0, HEIGHT), [], sheet.triangles.tolist())  # noqa: RUF005  an array
    cloth = bpy.data.objects.new("cloth", mesh)
    stage.collection.objects.link(cloth)
    add_obstacles()

    modifier = cloth.modifiers.new("cloth", "CLOTH")
    spacing = SIDE / (nodes - 1)
    modifier.settings.quality = 5
    # Mass stays 0.3 kg a vertex, as in Blender's cotton: the true one, below a gram, hangs in Blender's air like down.
    modifier.collision_settings.use_collision = True
    modifier.collision_settings.distance_min = THICKNESS_IN_SPACINGS * spacing
    modifier.collision_settings.use_self_collision = True
    modifier.collision_settings.self_distance_min = THICKNESS_IN_SPACINGS * spacing
    modifier.point_cache.frame_end = frames + 1

    seconds, processor_seconds = [], []
    for frame in range(1, frames + 2):
        start, processor_start = time.perf_counter(), time.process_time()
        stage.frame_set(frame)
        evaluated = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        seconds.append(time.perf_counter() - start)
        processor_seconds.append(time.process_time() - processor_start)
    positions = np.empty(3 * len(evaluated.vertices), dtype=np.float32)
    evaluated.vertices.foreach_get("co", positions)
    answer = {
        "blender": bpy.app.version_string,
        "seconds": seconds[1:],
        "processor_seconds": processor_seconds[1:],
        "positions": positions.reshape(-1, 3).tolist(),
        "triangles": sheet.triangles.tolist(),
    }
    json.dump(answer, sys.stdout)


def add_obstacles() -> None:
    """Ball and floor."""
    bpy.ops.mesh.primitive_uv_sphere_add(
        segments=64, ring_count=32, radius=BALL_RADIUS, location=(0.0, 0.0, BALL_HEIGHT)
    )
    ball = bpy.context.object
    bpy.ops.mesh.primitive_plane_add(size=4.0, location=(0.0, 0.0, FLOOR))
    for obstacle in (ball, bpy.context.object):
        obstacle.modifiers.new("collision", "COLLISION")
        obstacle.collision.thickness_outer = 0.001


if __name__ == "__main__":
    main()
