"""Files of animated meshes, and the meshes that they have."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, Vt

BOX_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ]
)  # fmt: skip
"""Of corners in the order of their coordinates, x last."""

ALEMBIC_WRITER = """
import bpy, numpy as np, sys
arrays = np.load(sys.argv[1])
points, faces, fps = arrays["points"], arrays["faces"], int(sys.argv[3])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps, scene.frame_start, scene.frame_end = fps, 1, len(points)
mesh = bpy.data.meshes.new("mesh")
mesh.from_pydata(points[0].tolist(), [], faces.tolist())
thing = bpy.data.objects.new("thing", mesh)
scene.collection.objects.link(thing)
thing.shape_key_add(name="rest")
for number, each in enumerate(points):
    key = thing.shape_key_add(name=str(number))
    key.data.foreach_set("co", each.ravel())
    for frame in range(len(points)):
        key.value = float(frame == number)
        key.keyframe_insert("value", frame=frame + 1)
bpy.ops.wm.alembic_export(filepath=sys.argv[2], start=1, end=len(points), evaluation_mode="RENDER")
"""


def box(size: tuple[float, float, float]) -> np.ndarray:
    """Corners of a box about the origin, (8, 3)."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=np.float64)
    return 0.5 * np.asarray(size) * corners


def ball(radius: float, subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an icosphere about the origin."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def write_usd(
    path: Path, points: np.ndarray, faces: np.ndarray, *, fps: float = 24.0, up: str = "z", unit_m: float = 1.0
) -> str:
    """A mesh of points (k, n, 3), in the file's unit and axes, one sample a frame; returns the path."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, unit_m)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(len(points))
    mesh = UsdGeom.Mesh.Define(stage, "/thing")
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    attribute = mesh.CreatePointsAttr()
    for number, each in enumerate(points):
        attribute.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(each, dtype=np.float32)), number + 1)
    stage.Save()
    return str(path)


def write_alembic(path: Path, points: np.ndarray, faces: np.ndarray, *, fps: int = 24) -> str:
    """The same by Blender, whose Alembic files are y-up: it reads them back z-up; returns the path."""
    arrays = path.with_suffix(".npz")
    np.savez(arrays, points=points.astype(np.float32), faces=faces)
    command = [sys.executable, "-c", ALEMBIC_WRITER, str(arrays), str(path), str(fps)]
    subprocess.run(command, capture_output=True, check=True)
    return str(path)
