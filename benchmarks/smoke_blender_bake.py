"""Bake a plume with Blender's own smoke; runs inside Blender, for `benchmarks.smoke_blender`.

blender --background --python smoke_blender_bake.py -- --cells 64 --frames 24 --fps 24 --threads 2 --cache FOLDER
python smoke_blender_bake.py -- --cells ...          where the module bpy is installed
"""

import argparse
import sys

import bpy


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cells", type=int, required=True)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--fps", type=int, required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--cache", required=True)
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
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(0.0, 0.0, 0.5))
    box = bpy.context.object
    domain = box.modifiers.new("Fluid", "FLUID")
    domain.fluid_type = "DOMAIN"
    settings = domain.domain_settings
    settings.domain_type, settings.resolution_max = "GAS", arguments.cells
    settings.vorticity = 0.3
    settings.use_collision_border_bottom = True
    settings.cache_type, settings.cache_data_format, settings.openvdb_data_depth = "ALL", "OPENVDB", "32"
    settings.cache_frame_start, settings.cache_frame_end = 1, arguments.frames
    settings.cache_directory = arguments.cache
    bpy.context.view_layer.objects.active = box
    bpy.ops.fluid.bake_all()
    sys.stdout.write(f"version {bpy.app.version_string}\n")


if __name__ == "__main__":
    main()
