"""PLY files: round trips, and every way in which one can be wrong."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import trimesh

from render.errors import InvalidFileError
from render.meshes import read_ply, validate_ply, write_ply


@pytest.fixture
def tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return vertices, faces


@pytest.fixture
def file(tmp_path: Path, tetrahedron) -> Path:
    path = tmp_path / "mesh.ply"
    vertices, faces = tetrahedron
    write_ply(path, vertices, faces, normals=vertices, velocities=2 * vertices)
    return path


@pytest.mark.parametrize("with_normals", [False, True])
@pytest.mark.parametrize("with_velocities", [False, True])
@pytest.mark.parametrize("with_uv", [False, True])
def test_a_mesh_reads_back_as_written(tmp_path, tetrahedron, with_normals, with_velocities, with_uv):
    vertices, faces = tetrahedron
    normals = vertices + 3 if with_normals else None
    velocities = vertices + 5 if with_velocities else None
    uv = vertices[:, :2] + 7 if with_uv else None
    path = tmp_path / "mesh.ply"
    write_ply(path, vertices, faces, normals=normals, velocities=velocities, uv=uv)
    validate_ply(path)
    mesh = read_ply(path)
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    for written, read in ((normals, mesh.normals), (velocities, mesh.velocities), (uv, mesh.uv)):
        if written is None:
            assert read is None
        else:
            np.testing.assert_array_equal(read, written)


def test_texture_coordinates_belong_to_corners_of_faces(tmp_path, tetrahedron):
    vertices, faces = tetrahedron
    places = np.linspace(0.0, 1.0, 24, dtype=np.float32).reshape(4, 3, 2)
    path = tmp_path / "mesh.ply"
    write_ply(path, vertices, faces, corner_uv=places)
    validate_ply(path)
    mesh = read_ply(path)
    assert mesh.corner_uv is not None
    np.testing.assert_array_equal(mesh.corner_uv, places)
    np.testing.assert_array_equal(mesh.faces, faces)
    content = path.read_bytes()
    elsewhere = trimesh.load(path, process=False)  # splits vertices
    np.testing.assert_array_equal(elsewhere.triangles, vertices[faces])
    np.testing.assert_array_equal(elsewhere.visual.uv[elsewhere.faces], places)
    path.write_bytes(content[:-24] + np.full(6, np.nan, "<f4").tobytes())
    with pytest.raises(InvalidFileError, match="texture coordinates of face 3 are not finite"):
        validate_ply(path)
    path.write_bytes(content[:-25] + b"\x04" + content[-24:])
    with pytest.raises(InvalidFileError, match="without two texture coordinates for each corner"):
        validate_ply(path)
    with pytest.raises(ValueError, match=r"corner_uv must have the shape \(4, 3, 2\)"):
        write_ply(path, vertices, faces, corner_uv=places[:3])


def test_other_software_reads_the_file(file, tetrahedron):
    mesh = trimesh.load(file, process=False)
    np.testing.assert_array_equal(mesh.vertices, tetrahedron[0])
    np.testing.assert_array_equal(mesh.faces, tetrahedron[1])
    np.testing.assert_array_equal(mesh.metadata["_ply_raw"]["vertex"]["data"]["vy"], 2 * tetrahedron[0][:, 1])


def test_types_and_memory_order_of_the_arrays_do_not_change_the_bytes(file, tmp_path, tetrahedron):
    vertices, faces = tetrahedron
    other = tmp_path / "other.ply"
    write_ply(
        other,
        np.asfortranarray(vertices, np.float64),
        faces.astype(np.uint64)[:, :],
        normals=vertices[::-1][::-1],
        velocities=(2 * vertices).tolist(),
    )
    assert other.read_bytes() == file.read_bytes()


def test_a_frame_without_fluid_is_a_mesh_without_vertices(tmp_path):
    path = tmp_path / "empty.ply"
    write_ply(path, np.empty((0, 3)), np.empty((0, 3)), normals=[], velocities=[])
    validate_ply(path)
    mesh = read_ply(path)
    assert mesh.vertices.shape == mesh.faces.shape == (0, 3)
    assert mesh.velocities is not None
    assert mesh.velocities.shape == (0, 3)


@pytest.mark.parametrize("missing", [1, 13, 100, -1, -20])
def test_a_file_of_another_size_is_refused(file, missing):
    content = file.read_bytes()
    file.write_bytes(content[:-missing] if missing > 0 else content + bytes(-missing))
    with pytest.raises(InvalidFileError, match=r"mesh\.ply: \d+ bytes, but its header promises \d+"):
        validate_ply(file)


@pytest.mark.parametrize("content", [b"", b"ply\n", bytes(5000), b"ply\nformat ascii 1.0\nend_header\n"])
def test_what_is_not_our_ply_is_refused(tmp_path, content):
    path = tmp_path / "other.ply"
    path.write_bytes(content)
    with pytest.raises(InvalidFileError, match=r"PLY"):
        validate_ply(path)


def test_a_header_without_positions_is_refused(file):
    file.write_bytes(file.read_bytes().replace(b"float z\n", b"float w\n"))
    with pytest.raises(InvalidFileError, match="expected layout"):
        validate_ply(file)


@pytest.mark.parametrize("column", ["vertices", "normals", "velocities", "uv"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(tmp_path, tetrahedron, column, value):
    vertices, faces = tetrahedron
    columns = {name: vertices.copy() for name in ("vertices", "normals", "velocities")} | {"uv": vertices[:, :2].copy()}
    columns[column][2, 1] = value
    path = tmp_path / "mesh.ply"
    write_ply(path, faces=faces, **columns)
    with pytest.raises(InvalidFileError, match=rf"{column} of vertex 2 are not finite"):
        validate_ply(path)


@pytest.mark.parametrize("index", [-1, 4])
def test_an_index_out_of_range_is_refused(tmp_path, tetrahedron, index):
    vertices, faces = tetrahedron
    faces[3, 2] = index
    path = tmp_path / "mesh.ply"
    write_ply(path, vertices, faces)
    with pytest.raises(InvalidFileError, match=f"names vertex {index}, but there are 4"):
        validate_ply(path)


def test_a_face_that_is_not_a_triangle_is_refused(file):
    content = bytearray(file.read_bytes())
    content[-13] = 4
    file.write_bytes(content)
    with pytest.raises(InvalidFileError, match="not a triangle"):
        read_ply(file)


def test_arrays_that_do_not_fit_together_are_refused(tmp_path, tetrahedron):
    vertices, faces = tetrahedron
    with pytest.raises(ValueError, match="'velocities': 3"):
        write_ply(tmp_path / "mesh.ply", vertices, faces, velocities=vertices[:3])
    with pytest.raises(ValueError, match=r"faces must have the shape \(n, 3\), got \(4, 2\)"):
        write_ply(tmp_path / "mesh.ply", vertices, faces[:, :2])


def test_the_error_survives_pickling():
    error = pickle.loads(pickle.dumps(InvalidFileError(Path("a.ply"), "is short")))
    assert str(error) == "a.ply: is short"
    assert error.path == Path("a.ply")
