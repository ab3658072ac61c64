"""What an HDRI and the textures of a .blend file take of a renderer's memory; see `pipeline.own_pictures`.

    python -m benchmarks.own_pictures

Draws a ball of 96x54 pixels in draft quality, twice in a process of its own for each kind of picture, and tells by how
much the largest resident memory grew over the same without any: outdoors, and under a material without textures.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.json_output import keep_output_for_json
from pipeline.executors.memory import peak_memory_bytes
from render.blender import open_renderer
from render.camera_path import CameraPath
from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters, RenderParameters, StageParameters
from render.spec import Camera, MeshObject, RenderSpec
from sim.shapes import build_solid
from sim.shapes.parameters import Placement, SphereShape

LOW, HIGH = (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)
SKIES = {"nothing": 0, "2048.hdr": 2048 * 1024, "4096.hdr": 4096 * 2048, "8192.hdr": 8192 * 4096}
SKIES |= {"half.exr": 4096 * 2048, "float.exr": 4096 * 2048}
TEXTURES = {"plain": 0, "bytes": 4096 * 4096, "floats": 4096 * 2048}


def write_files(folder: Path) -> None:
    """The pictures, full of noise; run in a process of its own, as it holds them all."""
    import bpy
    import numpy as np

    generator = np.random.default_rng(0)

    def noise(name: str, width: int, height: int, *, floats: bool):
        image = bpy.data.images.new(name, width, height, float_buffer=floats, alpha=False)
        image.pixels.foreach_set(generator.random(4 * width * height, dtype=np.float32))
        return image

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.view_settings.view_transform = "Standard"
    settings = scene.render.image_settings
    for name, pixels in SKIES.items():
        if not pixels:
            continue
        image = noise(name, round((2 * pixels) ** 0.5), round((pixels / 2) ** 0.5), floats=True)
        settings.file_format = "HDR" if name.endswith(".hdr") else "OPEN_EXR"
        if not name.endswith(".hdr"):
            settings.color_depth, settings.exr_codec = "16" if name == "half.exr" else "32", "ZIP"
        image.save_render(str(folder / name), scene=scene)
        bpy.data.images.remove(image)
    for name, pixels in TEXTURES.items():
        material = bpy.data.materials.new(name)
        material.use_fake_user = True
        if pixels:
            texture = material.node_tree.nodes.new("ShaderNodeTexImage")
            texture.image = noise(name, 4096, pixels // 4096, floats=name == "floats")
            texture.image.pack()
            shader = material.node_tree.nodes["Principled BSDF"]
            material.node_tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "textures.blend"))


def peak_bytes(folder: Path, what: str) -> int:
    """Largest resident memory of this process once it has drawn a ball with it."""
    sky = {"hdri": str(folder / what)} if SKIES.get(what) else {"name": "outdoor"}
    material = {"blend": f"{folder / 'textures.blend'}:{what}"} if what in TEXTURES else {"look": "metal"}
    ball = build_solid(Placement(shape=SphereShape(type="sphere", radius=0.2))).surface_mesh(0.02)
    write_ply(folder / "ball.ply", ball.vertices, ball.faces)
    camera = CameraParameters(position=(0.0, -2.5, 0.5), look_at=(0.0, 0.0, 0.5))
    path = CameraPath(camera, LOW, HIGH, aspect=16 / 9, starts={})
    spec = RenderSpec(
        fps=60.0,
        domain_min=LOW,
        domain_max=HIGH,
        camera=Camera.on(path, f_stop=None, views=""),
        stage=StageParameters.model_validate(sky),
        objects=(
            MeshObject(
                name="ball",
                file="ball.ply",
                position=(0.0, 0.0, 0.5),
                material=MaterialParameters.model_validate(material),
            ),
        ),
        render=RenderParameters(resolution=(96, 54), quality="draft", device="cpu"),
    )
    spec.write(folder / "spec.json")
    renderer = open_renderer(folder / "spec.json", threads=2, blender=None)
    for frame in range(2):
        renderer.render(frame, folder / f"{what}.png")
    renderer.close()
    return peak_memory_bytes()


def main() -> None:
    """Measure each kind of picture in a child process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", nargs=2, metavar=("FOLDER", "PICTURE"), help=argparse.SUPPRESS)
    asked = parser.parse_args().of
    if asked:
        folder, what = Path(asked[0]), asked[1]
        if what == "files":
            write_files(folder)
        else:
            keep_output_for_json()
            print(peak_bytes(folder, what))
        return

    def child(folder: str, what: str) -> str:
        command = [sys.executable, "-m", "benchmarks.own_pictures", "--of", folder, what]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    with tempfile.TemporaryDirectory(prefix="own-pictures-") as folder:
        child(folder, "files")
        for kinds in (SKIES, TEXTURES):
            without = 0
            for what, pixels in kinds.items():
                peak = int(child(folder, what))
                without = without or peak
                each = f", {(peak - without) / pixels:.1f} bytes a pixel" if pixels else ""
                print(
                    f"{what:>10}  {(peak - without) / 1e6:6.0f} MB more than {without / 1e6:.0f} MB{each}", flush=True
                )


if __name__ == "__main__":
    main()
