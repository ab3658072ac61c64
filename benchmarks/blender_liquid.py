"""Blender's own liquid beside ours: the drop of jobs/drop_on_bunny_dfsph.toml, at one moment, by one camera.

    blender -b --python benchmarks/blender_liquid.py -- renders/drop_on_bunny_dfsph 45 --resolution 96 --bake peer
    python -m benchmarks.blender_liquid renders/drop_on_bunny_dfsph 45 --drawn-from peer -o both.webp

The first line needs a Blender executable with Mantaflow, as distributions have it; the bpy module has none. It takes
block, box and bunny of the job's folder, which has been simulated and meshed, and writes the liquid's surface at one
frame. The second draws ours and that one with the job's look of water, without the motion blur that Blender's mesh has
no velocities for.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import Any


def bake(job_folder: Path, frame: int, resolution: int, folder: Path) -> None:
    """Simulate to a frame in Blender, mesh that one, and write it, FRAME.stl; `resolution` cells along the box."""
    import bpy

    job = tomllib.loads((job_folder / "job.toml").read_text(encoding="utf-8"))
    low, high = job["domain"]["min"], job["domain"]["max"]
    (body,), ((block,),) = job["rigid"], [fluid["block"] for fluid in job["fluid"]]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.render.fps, stage.frame_end = job.get("fps", 60), frame + 1

    def box(size: list[float], middle: list[float]) -> Any:
        bpy.ops.mesh.primitive_cube_add(size=1.0, location=middle)
        bpy.context.object.scale = size
        bpy.ops.object.transform_apply(scale=True, location=False, rotation=False)
        return bpy.context.object

    tank = box([b - a for a, b in zip(low, high)], [(a + b) / 2.0 for a, b in zip(low, high)])  # noqa: B905
    drop = box(block["shape"]["size"], block["position"])
    bpy.ops.import_mesh.ply(filepath=str(job_folder / "meshes" / f"{body['name']}.ply"))
    bunny = bpy.context.object
    bunny.location = body["position"]
    bunny.rotation_euler = [angle * 3.141592653589793 / 180.0 for angle in body["rotation_deg"]]
    for thing, kind in ((tank, "DOMAIN"), (drop, "FLOW"), (bunny, "EFFECTOR")):
        thing.modifiers.new("fluid", "FLUID").fluid_type = kind
    liquid, flow = tank.modifiers["fluid"].domain_settings, drop.modifiers["fluid"].flow_settings
    liquid.domain_type, liquid.cache_type, liquid.resolution_max = "LIQUID", "MODULAR", resolution
    liquid.cache_directory = str(folder / "cache")
    liquid.cache_resumable = True  # else a mesh made later is hollow: of the particles, which are in a band alone
    liquid.cache_frame_start, liquid.cache_frame_end = 1, frame + 1
    flow.flow_type, flow.flow_behavior = "LIQUID", "GEOMETRY"
    bpy.context.view_layer.objects.active = tank
    bpy.ops.fluid.bake_data()
    liquid.use_mesh, liquid.mesh_generator, liquid.mesh_scale = True, "IMPROVED", 2
    liquid.cache_frame_start = frame + 1
    bpy.ops.fluid.bake_mesh()
    stage.frame_set(frame + 1)
    bpy.ops.object.select_all(action="DESELECT")
    tank.select_set(True)
    bpy.ops.export_mesh.stl(filepath=str(folder / f"{frame:06d}.stl"), use_selection=True)


def draw(job_folder: Path, frame: int, peer: Path, output: Path) -> None:
    """Both liquids side by side: ours left, as the job's folder has it. Prints what the meshes hold [m³]."""
    import tempfile

    import numpy as np
    import trimesh
    from PIL import Image

    from render.blender import open_renderer
    from render.meshes import write_ply

    baked: trimesh.Trimesh = trimesh.load_mesh(peer / f"{frame:06d}.stl")
    baked.merge_vertices()
    print(json.dumps({"vertices": len(baked.vertices), "volume_m3": float(baked.volume)}))
    spec = json.loads((job_folder / "scene.json").read_text(encoding="utf-8"))
    spec["render"] |= {"motion_blur": False, "format": "png", "passes": []}
    pictures = []
    with tempfile.TemporaryDirectory() as name:
        for objects, own in ((spec["objects"], job_folder), (without_drops(spec["objects"]), Path(name))):
            root = Path(name) / own.name
            root.mkdir(exist_ok=True)
            if own is not job_folder:
                surface = root / "surfaces" / "water" / f"{frame:06d}.ply"
                surface.parent.mkdir(parents=True)
                still = np.zeros_like(baked.vertices)
                write_ply(surface, baked.vertices, baked.faces, normals=baked.vertex_normals, velocities=still)
            for part in job_folder.iterdir():
                if part.is_dir() and not (root / part.name).exists():
                    (root / part.name).symlink_to(part.resolve())
            document = root / "scene.json"
            document.write_text(json.dumps({**spec, "objects": objects}), encoding="utf-8")
            renderer = open_renderer(document, threads=2, blender=None)
            picture = root / "picture.png"
            renderer.render(frame, picture)
            renderer.close()
            with Image.open(picture) as drawn:
                pictures.append(drawn.convert("RGB"))
    width, height = pictures[0].size
    both = Image.new("RGB", (2 * width, height))
    for number, picture in enumerate(pictures):
        both.paste(picture, (number * width, 0))
    both.save(output, quality=85, method=6)


def without_drops(objects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of a scene, those that are no points: Blender's liquid is its surface alone."""
    return [each for each in objects if each["type"] != "point_sequence"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", type=Path, help="the folder of the drop")
    parser.add_argument("frame", type=int, help="the moment")
    parser.add_argument("--resolution", type=int, default=96, help="cells of Blender's grid along the box")
    parser.add_argument("--bake", type=Path, help="in Blender: folder to write to")
    parser.add_argument("--drawn-from", type=Path, help="folder that Blender wrote")
    parser.add_argument("-o", "--output", type=Path, default=Path("both.webp"))
    in_blender = "--" in sys.argv
    arguments = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if in_blender else None)
    if in_blender:
        bake(arguments.job.resolve(), arguments.frame, arguments.resolution, arguments.bake.resolve())
    else:
        draw(arguments.job.resolve(), arguments.frame, arguments.drawn_from.resolve(), arguments.output)


if __name__ == "__main__":
    main()
