"""Animated meshes of Alembic and USD files as arrays: `python read_animation.py FILE OUT FPS OBJECT`.

FPS: samples a second [1/s], a USD file's own; OBJECT: name of the mesh that is meant, "" for all of them.
OUT is an .npz of times [s], (k,), points in the world, z up [m], (k, n, 3) float32, and triangles, (m, 3) int32.
Where the file cannot be used a sentence why goes to OUT.txt instead.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

MOST_BYTES = 2**31
"""Of the points of all samples."""


class UnusableAnimationError(Exception):
    """A file that no animation can be made of."""


def main(file: str, out: str, fps: str, name: str) -> None:
    """Read a file."""
    try:
        times, points, triangles = read(Path(file), float(fps), name)
    except UnusableAnimationError as error:
        Path(f"{out}.txt").write_text(str(error), encoding="utf-8")
        return
    np.savez(out, times=times, points=points, triangles=triangles)


def read(file: Path, fps: float, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times from the first sample on [s], points [m] and triangles of a file.

    Raises UnusableAnimationError: it has none.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    # An Alembic file has times, which become frames by the scene's rate; a USD file has frames, and a rate of its own.
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    is_alembic = file.suffix.lower() == ".abc"
    importer = bpy.ops.wm.alembic_import if is_alembic else bpy.ops.wm.usd_import
    further = {"as_background_job": False} if is_alembic else {}
    try:
        outcome = importer(filepath=str(file), set_frame_range=True, **further)
    except RuntimeError as error:
        raise UnusableAnimationError(f"cannot be read ({str(error).strip()}); export it again") from error
    if outcome != {"FINISHED"} or (is_alembic and not bpy.data.cache_files):
        raise UnusableAnimationError("cannot be read; export it again")
    meshes = meshes_of(name)
    first, last = scene.frame_start, scene.frame_end
    if last <= first:
        raise UnusableAnimationError(
            "has one sample alone, or does not say from when to when it goes, so that nothing moves; export its "
            'animation, or take a shape of type "mesh"'
        )
    times = np.arange(last - first + 1) / fps
    return times, *sampled(scene, meshes, times, first)


def meshes_of(name: str) -> list[bpy.types.Object]:
    """The meshes that are meant, by name."""
    meshes = sorted((each for each in bpy.data.objects if each.type == "MESH"), key=lambda each: each.name)
    if name:
        found = [each for each in meshes if name in (each.name, each.parent.name if each.parent else "")]
        if not found:
            names = ", ".join(f'"{each.name}"' for each in meshes) or "none"
            raise UnusableAnimationError(f'has no mesh named "{name}"; its meshes: {names}')
        return found
    if not meshes:
        raise UnusableAnimationError("has no mesh; export meshes, not curves, points or instances")
    return meshes


def sampled(
    scene: bpy.types.Scene, meshes: list[bpy.types.Object], times: np.ndarray, first_frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points at each time, (k, n, 3), one a frame, and triangles, which all share."""
    scene.frame_set(first_frame)
    found = list(evaluated(meshes))
    polygons = [each for _, each, _ in found]
    starts = np.cumsum([0, *(len(each) for each, _, _ in found)])
    triangles = np.concatenate([each + start for (_, _, each), start in zip(found, starts, strict=False)])
    count = int(starts[-1])
    needed = 12.0 * len(times) * count
    if needed > MOST_BYTES:
        raise UnusableAnimationError(
            f"has {len(times):,} samples of {count:,} points, {needed / 1e9:.2g} GB; {MOST_BYTES / 1e9:.2g} GB can be "
            "used: export a coarser mesh, or fewer samples"
        )
    points = np.empty((len(times), count, 3), dtype=np.float32)
    for number, time_s in enumerate(times):
        scene.frame_set(first_frame + number)
        found = list(evaluated(meshes))
        places = np.concatenate([each for each, _, _ in found])
        if len(places) != count or not all(map(np.array_equal, polygons, (each for _, each, _ in found))):
            raise UnusableAnimationError(
                f"changes its mesh at sample {number}, {time_s:.4g} s after its first: {len(places):,} points instead "
                f"of {count:,}, or other faces; export a mesh that deforms, whose points move and whose faces stay"
            )
        if not np.isfinite(places).all():
            raise UnusableAnimationError(f"has points that are no numbers at sample {number}; export it again")
        points[number] = places
    return points, triangles.astype(np.int32)


def evaluated(meshes: list[bpy.types.Object]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points in the world, vertices of all polygons with how many each has, and triangles, of each mesh."""
    graph = bpy.context.evaluated_depsgraph_get()
    for each in meshes:
        own = each.evaluated_get(graph)
        mesh = own.to_mesh()
        local = np.empty(3 * len(mesh.vertices), dtype=np.float32)
        mesh.vertices.foreach_get("co", local)
        matrix = np.array(own.matrix_world, dtype=np.float64)
        corners, sizes = np.empty(len(mesh.loops), dtype=np.int32), np.empty(len(mesh.polygons), dtype=np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        mesh.polygons.foreach_get("loop_total", sizes)
        mesh.calc_loop_triangles()
        triangles = np.empty(3 * len(mesh.loop_triangles), dtype=np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles)
        places = local.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        yield places.astype(np.float32), np.concatenate([sizes, corners]), triangles.reshape(-1, 3)
        own.to_mesh_clear()


if __name__ == "__main__":
    main(*sys.argv[1:])
