"""Small pictures of looks and stages for docs/guide/rendering.md, drawn as a job's frames are.

    python -m benchmarks.looks docs/guide/images [--only wood milk window] [--quality preview] [--suffix .webp]

Solid looks are shown on a bunny and a ball, liquids as a drop that lies on the ground and one that falls, cloths as
sheets that lie and hang, each in its own colour, dark and light, in the stage `studio`; stages with a bunny of ceramic
and a ball of metal. Writes `look-NAME` and `stage-NAME`, and tells how many seconds and processor seconds each took.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from blender_scripts.look_table import CLOTHS, LOOK_TABLE, looks_for
from blender_scripts.optics import usual_density
from render.blender import open_renderer
from render.camera_path import CameraPath
from render.cloth import vertex_normals
from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters, RenderParameters, SetParameters
from render.point_clouds import KINDS
from render.spec import Camera, MeshObject, MeshSequenceObject, RenderSpec
from sim.shapes.parameters import BunnyShape, Placement, SphereShape
from sim.shapes.placement import build_solid

WIDTH, HEIGHT = 240, 180
DROP_SIZE = 0.65  # of both drops as one liquid: the edge of the cube of their volume [m]
BESIDE = (-1.1, 0.05, 1.2)
"""Where three things stand in a wide picture, along x [m]."""
SHEETS_BESIDE = (-1.08, -0.04, 1.0)
"""Where three sheets do, which are wider [m]."""
LOW, HIGH = (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)
CLOTH_LOOKS = tuple(name for name, row in LOOK_TABLE.items() if row.bodies == CLOTHS)
LIQUID_LOOKS = tuple(name for name in looks_for("fluid") if "density" in LOOK_TABLE[name].keys)
SOLID_LOOKS = tuple(name for name in looks_for("rigid") if name not in (*LIQUID_LOOKS, *KINDS))
CLOTH_COLORS = (None, (0.02, 0.02, 0.022), (0.72, 0.70, 0.66))
"""Of a cloth's three sheets: its own, a dark and a light one."""
STAGES = {
    "studio": SetParameters(),
    "outdoor": SetParameters(name="outdoor"),
    "night": SetParameters(name="night", strength=4.0),
    "window": SetParameters(name="window"),
    "window-wood": SetParameters(name="window", ground="wood"),
    "studio-stone": SetParameters(ground="stone"),
    "plain": SetParameters(background="plain", color=(0.9, 0.9, 0.9)),
}


@dataclass(frozen=True)
class Scene:
    """What a picture shows, and its width [pixels]."""

    objects: tuple[MeshObject | MeshSequenceObject, ...]
    stage: SetParameters = STAGES["studio"]
    width: int = WIDTH


def write_shapes(folder: Path) -> None:
    """A bunny, a ball and a drop that lies on the ground, each around the point that it is placed by."""
    bunny = build_solid(Placement(shape=BunnyShape(type="bunny", height=0.8))).surface_mesh(None)
    ball = build_solid(Placement(shape=SphereShape(type="sphere", radius=0.5))).surface_mesh(0.02)
    write_ply(folder / "bunny.ply", bunny.vertices, bunny.faces)
    write_ply(folder / "ball.ply", 0.5 * ball.vertices, ball.faces)
    write_ply(folder / "drop.ply", 0.26 * ball.vertices, ball.faces)
    # Flat below, and a little in the floor: it wets what it lies on.
    lying = ball.vertices * (1.0, 1.0, 0.56)
    lying[:, 2] = np.maximum(lying[:, 2], -0.18) + 0.16
    write_ply(folder / "lying.ply", lying, ball.faces)
    for place, x in enumerate(SHEETS_BESIDE):
        write_table_cloth(folder / f"sheet{place}.ply", x)


def write_table_cloth(path: Path, x: float, *, width: float = 0.85, counts: int = 181) -> None:
    """A sheet around x that lies flat half a metre above the ground and hangs down in front, in folds."""
    s, t = (each.ravel() for each in np.meshgrid(*[np.linspace(0.0, 1.0, counts)] * 2, indexing="ij"))
    edge = 0.06
    turned = np.clip((t - 0.5) / edge, 0.0, 0.5 * np.pi)
    hanging = np.maximum(t - 0.5 - 0.5 * np.pi * edge, 0.0)
    fold = 0.12 * np.minimum(3.0 * hanging, 1.0) * np.cos(6.0 * np.pi * s)
    y = 0.25 - np.minimum(t, 0.5) - edge * np.sin(turned) + fold
    z = 0.5 - edge * (1.0 - np.cos(turned)) - hanging
    vertices = np.stack([x + width * (s - 0.5), y, z], axis=1)
    first = (counts * np.arange(counts - 1)[:, None] + np.arange(counts - 1)).ravel()
    corners = np.stack([first, first + counts, first + counts + 1, first + 1], axis=1)
    faces = np.concatenate([corners[:, (0, 2, 1)], corners[:, (0, 3, 2)]])
    uv = np.stack([width * s, t], axis=1)
    write_ply(path, vertices, faces, normals=vertex_normals(vertices, faces), velocities=0 * vertices, uv=uv)


def solids(first: MaterialParameters, second: MaterialParameters) -> tuple[MeshObject, ...]:
    """A bunny and a ball."""
    return (
        MeshObject(name="bunny", file="bunny.ply", position=(-0.2, 0.05, 0.4), material=first),
        MeshObject(name="ball", file="ball.ply", position=(0.42, -0.12, 0.25), material=second),
    )


def liquid(look: str, x: float = 0.05) -> tuple[MeshObject, ...]:
    """A drop that lies there, and one that falls."""
    material = MaterialParameters(look=look, density=usual_density(look, DROP_SIZE))
    return (
        MeshObject(name=f"lying {x}", file="lying.ply", position=(x, 0.0, 0.0), material=material),
        MeshObject(name=f"falling {x}", file="drop.ply", position=(x + 0.1, 0.0, 0.66), material=material),
    )


def sheets(look: str) -> tuple[MeshSequenceObject, ...]:
    """Three sheets of one look: in its own colour, dark and light."""
    return tuple(
        MeshSequenceObject(
            name=f"sheet {place}", file=f"sheet{place}.ply", material=MaterialParameters(look=look, color=color)
        )
        for place, color in enumerate(CLOTH_COLORS)
    )


def draw(folder: Path, scene: Scene, options: argparse.Namespace) -> Path:
    """Draw one picture; returns where it is."""
    camera = CameraParameters(
        position=(0.35, -3.0, 1.25), look_at=(0.05, 0.0, 0.38), focal_length_mm=76.0 if scene.width == WIDTH else 33.0
    )
    path = CameraPath(camera, LOW, HIGH, aspect=scene.width / HEIGHT, starts={})
    spec = RenderSpec(
        fps=60.0,
        domain_min=LOW,
        domain_max=HIGH,
        camera=Camera.on(path, f_stop=None, views=""),
        set=scene.stage,
        objects=scene.objects,
        render=RenderParameters(resolution=(scene.width, HEIGHT), quality=options.quality, device="cpu"),
    )
    spec.write(folder / "spec.json")
    renderer = open_renderer(folder / "spec.json", threads=2, blender=None)
    renderer.render(0, folder / "picture.png")
    renderer.close()
    return folder / "picture.png"


def all_scenes() -> dict[str, Scene]:
    """Every picture by its name."""
    ceramic, metal = MaterialParameters(look="ceramic"), MaterialParameters(look="metal")
    scenes = {}
    for look in SOLID_LOOKS:
        material = MaterialParameters(look=look)
        scenes[f"look-{look}"] = Scene(solids(material, material))
    for look in LIQUID_LOOKS:
        scenes[f"look-{look}"] = Scene(liquid(look))
    beside = [liquid(look, x) for look, x in zip(LIQUID_LOOKS, BESIDE, strict=True)]
    scenes["look-liquids"] = Scene(sum(beside, ()), width=2 * WIDTH)
    for cloth in CLOTH_LOOKS:
        scenes[f"look-{cloth}"] = Scene(sheets(cloth), width=2 * WIDTH)
    for name, stage in STAGES.items():
        scenes[f"stage-{name}"] = Scene(solids(ceramic, metal), stage)
    return scenes


def main() -> None:
    """Draw the pictures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the pictures go")
    parser.add_argument("--only", nargs="+", default=[], help="names of looks and stages (default: all)")
    parser.add_argument("--quality", default="preview", choices=("draft", "preview", "final"))
    parser.add_argument("--suffix", default=".webp", help="of the pictures (default: .webp)")
    options = parser.parse_args()
    scenes = all_scenes()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_shapes(folder)
        for title, scene in scenes.items():
            if options.only and title.partition("-")[2] not in options.only:
                continue
            start, cpu_start = time.perf_counter(), time.process_time()
            picture = draw(folder, scene, options)
            seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
            with Image.open(picture) as image:
                image.save(options.folder / f"{title}{options.suffix}", quality=82)
            print(f"{title}: {seconds:.1f} s, {cpu_seconds:.1f} processor seconds", flush=True)


if __name__ == "__main__":
    main()
