"""glTF files: what is shown when, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from blender_scripts.ply import SurfaceMesh
from render.camera_path import View
from render.errors import InvalidFileError
from render.gltf_files import TooLargeError, read_glb, validate_glb, write_glb
from render.parameters import MaterialParameters, RenderParameters, SetParameters
from render.poses import Placement, the_short_way
from render.spec import Camera, MeshSequenceObject, MovingMeshObject, RenderSpec

VIEW = View((0.0, -2.0, 1.0), (0.0, 0.0, 1.0), 50.0, 2.0)


def surface(triangles: int) -> SurfaceMesh:
    vertices = np.arange(9 * triangles, dtype=np.float32).reshape(-1, 3)
    faces = np.arange(3 * triangles, dtype=np.int32).reshape(-1, 3)
    return SurfaceMesh(vertices, faces, normals=np.tile(np.float32([0, 0, 1]), (3 * triangles, 1)))


def written(folder: Path, surfaces: list[SurfaceMesh], *, limit_bytes: int = 1_000_000) -> Path:
    """A file of a cube that turns and of a surface."""
    material = MaterialParameters(look="water", density=1.0)
    spec = RenderSpec(
        fps=10.0,
        domain_min=(0.0, 0.0, 0.0),
        domain_max=(1.0, 1.0, 1.0),
        camera=Camera(
            position=VIEW.position,
            look_at=VIEW.look_at,
            focal_length_mm=50.0,
            focus_distance=2.0,
            longest_focal_length_mm=50.0,
        ),
        set=SetParameters(),
        objects=(
            MovingMeshObject(name="cube", file="cube.ply", body="cube", poses="{frame}", material=material),
            MeshSequenceObject(name="water", file="{frame}.ply", material=material),
        ),
        render=RenderParameters(),
    )
    count, cube = len(surfaces), trimesh.creation.box()
    path = folder / "scene.glb"
    write_glb(
        path,
        spec,
        times=[0.1 * frame for frame in range(count)],
        meshes={"cube": SurfaceMesh(cube.vertices.astype(np.float32), cube.faces.astype(np.int32))},
        sequences={"water": surfaces},
        placements={"cube": [Placement((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))] * count},
        views=[VIEW],
        limit_bytes=limit_bytes,
    )
    validate_glb(path)
    return path


def shown(path: Path) -> dict[str, list[tuple[float, float]]]:
    """Of each node that is hidden or shown: when it becomes what."""
    document, arrays = read_glb(path.read_bytes())
    (animation,) = document["animations"]
    found = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        if channel["target"]["path"] == "scale":
            assert sampler["interpolation"] == "STEP"
            times, scales = arrays[sampler["input"]], arrays[sampler["output"]]
            found[document["nodes"][channel["target"]["node"]]["name"]] = [
                (round(float(time), 3), float(scale[0])) for time, scale in zip(times, scales, strict=True)
            ]
    return found


def test_one_surface_is_shown_at_a_time_and_none_where_it_is_empty(tmp_path):
    path = written(tmp_path, [surface(2), surface(0), surface(3), surface(1)])
    assert shown(path) == {
        "water.0": [(0.0, 1.0), (0.1, 0.0)],
        "water.2": [(0.0, 0.0), (0.2, 1.0), (0.3, 0.0)],
        "water.3": [(0.0, 0.0), (0.3, 1.0)],
    }


def test_one_frame_is_not_animated_and_edges_of_bodies_are_sharp(tmp_path):
    document, arrays = read_glb(written(tmp_path, [surface(1)]).read_bytes())
    assert "animations" not in document
    cube = document["meshes"][0]["primitives"][0]
    normals = arrays[cube["attributes"]["NORMAL"]]
    assert len(normals) == 24  # four corners of six sides
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0, atol=1e-6)


def test_indices_are_as_wide_as_they_need_to_be(tmp_path):
    for triangles, code in ((21_845, 5123), (21_846, 5125)):
        path = written(tmp_path, [surface(triangles)], limit_bytes=10_000_000)
        document, _ = read_glb(path.read_bytes())
        part = next(each for each in document["meshes"] if each["name"] == "water.0")["primitives"][0]
        assert document["accessors"][part["indices"]]["componentType"] == code


def test_a_file_that_would_be_too_large_is_refused(tmp_path):
    frames = [surface(100)] * 4
    size = written(tmp_path, frames).stat().st_size
    with pytest.raises(TooLargeError):
        written(tmp_path, frames, limit_bytes=size // 2)


@pytest.mark.parametrize("part", [0.2, 0.9, 0.9999])
def test_a_truncated_file_is_refused(tmp_path, part):
    path = written(tmp_path, [surface(10)])
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InvalidFileError):
        validate_glb(path)


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    mesh = surface(10)
    path = written(tmp_path, [mesh])
    content = path.read_bytes().replace(mesh.vertices[5, :1].tobytes(), np.float32([np.nan]).tobytes())
    path.write_bytes(content)
    with pytest.raises(InvalidFileError, match="finite"):
        validate_glb(path)


def test_turns_go_the_short_way():
    turns = np.array([[1.0, 0.0, 0.0, 0.0], [-0.9, -0.1, 0.0, 0.0], [0.8, 0.2, 0.0, 0.0], [-0.7, -0.3, 0.0, 0.0]])
    np.testing.assert_array_equal(the_short_way(turns), np.abs(turns))
