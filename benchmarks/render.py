"""What the renderer costs on top of Blender itself: a chunk of frames through `open_renderer` against a bare bpy loop.

    python -m benchmarks.render [--frames 4] [--resolution 480 270] [--quality draft] [--threads 1] [--triangles 60000]

Both sides draw the same frames of the same scene (a water surface, smoke and a ball, with motion blur) in one process,
in turns, so that a busy machine slows both. The bare loop has its arrays in memory already, fills the mesh, swaps the
volume's file and lets Blender write the picture. Prints JSON: seconds a frame and the ratio (aim: at most 1.1), by
wall time and by CPU time; the first frame of each side warms up and is not counted. The medians of the pairs count.
"""

import argparse
import math
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.compare import arguments_of, run, timed
from render.blender import open_renderer
from render.camera_path import CameraPath
from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters, RenderParameters, SetParameters, VolumeParameters
from render.spec import Camera, MeshSequenceObject, RenderSpec, VolumeSequenceObject
from render.volume import write_volume

FPS = 60.0


def wave(frame: int, triangle_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A flat drop of water with a travelling wave, of about so many triangles: positions, these, normals, velocity."""
    drop = trimesh.creation.icosphere(subdivisions=max(1, round(math.log(triangle_count / 20, 4))), radius=0.5)
    phase = 9.0 * drop.vertices[:, 0] + 3.0 * drop.vertices[:, 1] - 6.0 * frame / FPS
    drop.vertices = drop.vertices * (1.0, 1.0, 0.3)
    drop.vertices[:, 2] += 0.2 + 0.05 * np.sin(phase)
    velocity = np.outer(-6.0 * 0.05 * np.cos(phase), (0.0, 0.0, 1.0))
    columns = drop.vertices, drop.vertex_normals, velocity
    positions, normals, velocities = (each.astype(np.float32) for each in columns)
    return positions, drop.faces.astype(np.int32), normals, velocities


def write_smoke(path: Path, frame: int, cells: int = 64) -> None:
    """A rising column."""
    centres = (np.arange(cells) + 0.5) / cells
    x, y, z = np.meshgrid(centres - 0.5, centres - 0.5, centres, indexing="ij")
    distance = np.hypot(x - 0.06 * np.sin(7 * z - 4 * frame / FPS), y) / (0.06 + 0.1 * z)
    density = np.clip(1.3 - distance, 0.0, 1.0).astype(np.float32) * (z > 0.3)
    velocity = np.zeros((cells, cells, cells, 3), np.float32)
    velocity[..., 2] = 1.0
    write_volume(
        path,
        density=density.astype(np.float32),
        temperature=(293.0 + 60.0 * density).astype(np.float32),
        velocity=velocity,
        origin=(-0.5, -0.5, 0.0),
        cell_size=1.0 / cells,
        ambient_temperature=293.0,
        parameters=VolumeParameters(),
        fps=FPS,
        shutter=RenderParameters().shutter,
    )


def write_scene(folder: Path, frames: list[int], options: argparse.Namespace) -> Path:
    """All files of the scene; returns the specification's path."""
    for frame in frames:
        positions, triangles, normals, velocities = wave(frame, options.triangles)
        write_ply(folder / f"water{frame:06d}.ply", positions, triangles, normals=normals, velocities=velocities)
        write_smoke(folder / f"smoke{frame:06d}.vdb", frame)
    width, height = options.resolution
    path = CameraPath(CameraParameters(), (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0), aspect=width / height, starts={})
    spec = RenderSpec(
        fps=FPS,
        domain_min=(-0.5, -0.5, 0.0),
        domain_max=(0.5, 0.5, 1.0),
        camera=Camera.on(path, f_stop=None, views=""),
        set=SetParameters(),
        objects=(
            MeshSequenceObject(
                name="water", file="water{frame}.ply", material=MaterialParameters(look="water", density=4.0)
            ),
            VolumeSequenceObject(
                name="smoke",
                file="smoke{frame}.vdb",
                box_min=(-0.5, -0.5, 0.0),
                box_max=(0.5, 0.5, 1.0),
                open_faces=(),
                ambient_temperature=293.0,
                material=MaterialParameters(look="smoke", density=12.7),
            ),
        ),
        render=RenderParameters(resolution=tuple(options.resolution), quality=options.quality, device="cpu"),
    )
    spec.write(folder / "spec.json")
    return folder / "spec.json"


def bare_loop(folder: Path, triangle_count: int, frames: list[int]) -> Callable[[int], None]:
    """What one would write by hand for the scene that is open."""
    import bpy

    mesh, volume, scene = bpy.data.meshes["water"], bpy.data.volumes["smoke"], bpy.context.scene
    arrays = {frame: wave(frame, triangle_count) for frame in frames}
    scene.render.use_file_extension = False

    def draw(frame: int) -> None:
        positions, triangles, normals, velocities = arrays[frame]
        mesh.clear_geometry()
        mesh.vertices.add(len(positions))
        mesh.attributes["position"].data.foreach_set("vector", positions.ravel())
        mesh.loops.add(triangles.size)
        mesh.loops.foreach_set("vertex_index", triangles.ravel())
        mesh.polygons.add(len(triangles))
        mesh.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
        for name, values in (("velocity", velocities), ("custom_normal", normals)):
            mesh.attributes.new(name, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", values.ravel())
        mesh.update(calc_edges=True)
        volume.filepath = str(folder / f"smoke{frame:06d}.vdb")
        volume.grids.load()
        scene.frame_set(frame)
        scene.render.filepath = str(folder / f"bare{frame}.png")
        bpy.ops.render.render(write_still=True)

    return draw


def main() -> dict[str, object]:
    parser = arguments_of(__doc__)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--resolution", type=int, nargs=2, default=(480, 270))
    parser.add_argument("--quality", default="draft", choices=("draft", "preview", "final"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--triangles", type=int, default=60_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, frames = Path(name), list(range(options.frames + 1))
        renderer = open_renderer(write_scene(folder, frames, options), threads=options.threads, blender=None)
        bare = bare_loop(folder, options.triangles, frames)
        pairs = []
        for frame in frames:
            sides = [
                lambda frame=frame: renderer.render(frame, folder / f"ours{frame}.png"),
                lambda frame=frame: bare(frame),
            ]
            # Whoever goes second finds warm caches: take turns.
            order = (0, 1) if frame % 2 else (1, 0)
            times = {side: timed(sides[side]) for side in order}
            pairs.append((times[0], times[1]))
        renderer.close()
    counted = pairs[1:]
    result = {"benchmark": "render", **vars(options)}
    for kind, column in (("wall", 0), ("cpu", 1)):
        result[f"{kind}_s_per_frame"] = round(statistics.median(ours[column] for ours, _ in counted), 3)
        result[f"{kind}_s_per_frame_bare"] = round(statistics.median(bare_[column] for _, bare_ in counted), 3)
        result[f"{kind}_ratio"] = round(statistics.median(ours[column] / bare_[column] for ours, bare_ in counted), 3)
    return result


if __name__ == "__main__":
    run(main)
