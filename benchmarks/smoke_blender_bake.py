"""Bake a plume with Blender's own smoke; runs inside Blender, for `benchmarks.smoke_blender`.

blender --background --debug-depsgraph-no-threads --python smoke_blender_bake.py -- \\
    --cells 64 64 64 --frames 24 --fps 24 --threads 2 --cache FOLDER
python smoke_blender_bake.py -- --cells ...          where the module bpy is installed

The last line that it prints is `baked` and JSON: Blender's version, and for each frame but the first the steps, the
processor time of all threads and the clock time [s] from the writing of the frame before to its own.
"""

import argparse
import json
import sys
import time
from types import FrameType

import bpy


class Watch:
    """Notes the steps of Mantaflow and when it writes; Blender tells neither, but its solver is driven by Python.

    The functions are those of the script that Blender makes for a gas domain, a number of the domain after each name.
    Only those that the thread calls which watches are seen: Blender needs `--debug-depsgraph-no-threads`.
    """

    def __init__(self) -> None:
        self._steps = 0
        self._writings: list[tuple[int, float, float]] = []

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """Called by Python for every function that begins or ends."""
        name = frame.f_code.co_name
        if event == "call" and name.startswith("smoke_step_"):
            self._steps += 1
        elif event == "call" and name.startswith("smoke_save_data_"):
            self._writings.append((self._steps, time.process_time(), time.perf_counter()))

    def frames(self) -> dict[str, list[float]]:
        """Steps, processor time and clock time of every frame but the first."""
        pairs = list(zip(self._writings, self._writings[1:], strict=False))
        return {
            name: [after[index] - before[index] for before, after in pairs]
            for index, name in enumerate(("steps", "processor_s", "clock_s"))
        }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cells", type=int, nargs=3, required=True)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--fps", type=int, required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--cache", required=True)
    parser.add_argument("--cfl", type=float)
    parser.add_argument("--steps", type=int)
    arguments = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.threads_mode, scene.render.threads = "FIXED", arguments.threads
    scene.render.fps = arguments.fps
    scene.frame_start, scene.frame_end = 1, arguments.frames
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.1, location=(0.0, 0.0, 0.15))
    source = bpy.context.object
    flow = source.modifiers.new("Fluid", "FLUID")
    flow.fluid_type = "FLOW"
    flow.flow_settings.flow_type, flow.flow_settings.flow_behavior = "SMOKE", "INFLOW"
    width, depth, height = (count / arguments.cells[0] for count in arguments.cells)
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(0.0, 0.0, 0.5 * height))
    box = bpy.context.object
    box.dimensions = (width, depth, height)
    domain = box.modifiers.new("Fluid", "FLUID")
    domain.fluid_type = "DOMAIN"
    settings = domain.domain_settings
    settings.domain_type, settings.resolution_max = "GAS", max(arguments.cells)
    settings.vorticity = 0.3
    settings.use_collision_border_bottom = True
    settings.cache_type, settings.cache_data_format, settings.openvdb_data_depth = "ALL", "OPENVDB", "32"
    settings.cache_frame_start, settings.cache_frame_end = 1, arguments.frames
    settings.cache_directory = arguments.cache
    if arguments.cfl is not None:
        settings.cfl_condition, settings.timesteps_max = arguments.cfl, 100
    if arguments.steps is not None:
        settings.timesteps_max = settings.timesteps_min = arguments.steps
    bpy.context.view_layer.objects.active = box
    watch = Watch()
    sys.setprofile(watch)
    bpy.ops.fluid.bake_all()
    sys.setprofile(None)
    sys.stdout.write(f"baked {json.dumps({'version': bpy.app.version_string, **watch.frames()})}\n")


if __name__ == "__main__":
    main()
