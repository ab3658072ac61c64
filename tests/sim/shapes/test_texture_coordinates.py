"""Texture coordinates of mesh files on the meshes of their solids, which are repaired."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals

from sim.shapes.mesh_file import read_texture_coordinates, read_upright_triangles, texture_coordinates
from sim.shapes.mesh_solid import boundary_loops, cap_holes, merge_vertices
from sim.shapes.parameters import MeshShape, Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import TriangleMesh

EDGE = 0.4


def unfolded_box() -> trimesh.Trimesh:
    """Each side has vertices of its own, and lies by its number in a row of six squares."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    vertices, uv, faces = [], [], []
    for side in range(6):
        axis, positive = divmod(side, 2)
        across = [(axis + 1) % 3, (axis + 2) % 3]
        own = box.faces[box.face_normals[:, axis] > 0.5 if positive else box.face_normals[:, axis] < -0.5]
        corners = box.vertices[own.ravel()]
        faces.append(6 * side + np.arange(6).reshape(2, 3))
        vertices.append(corners)
        uv.append((corners[:, across] / 4.0 + 0.5 + [side, 0.0]) / [6.0, 1.0])
    visual = TextureVisuals(uv=np.concatenate(uv))
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)


def write_obj(path: Path, box: trimesh.Trimesh, *, turned: bool = False, sides: int = 6) -> None:
    """Vertices that sides share, texture coordinates that they do not."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in box.vertices.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in box.visual.uv.tolist()]
    for face in box.faces[: 2 * sides] + 1:
        order = face[::-1] if turned else face
        lines.append("f " + " ".join(f"{corner}/{corner}" for corner in order))
    path.write_text("\n".join(lines))


def expected(mesh: TriangleMesh) -> np.ndarray:
    """What `unfolded_box` gives, by place and normal."""
    normals = mesh.area_vectors
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0.0)
    across = np.stack([(axis + 1) % 3, (axis + 2) % 3], axis=1)
    places = np.take_along_axis(mesh.corners, across[:, None, :].repeat(3, axis=1), axis=2) / EDGE * 2.0
    return (places / 4.0 + 0.5 + np.stack([side, np.zeros_like(side)], axis=1)[:, None]) / [6.0, 1.0]


def carried(path: Path) -> tuple[TriangleMesh, np.ndarray | None]:
    shape = MeshShape(type="mesh", file=str(path), size=EDGE, up="z")
    mesh = build_solid(Placement(shape=shape)).rest_mesh()
    return mesh, texture_coordinates(mesh, shape)


@pytest.mark.parametrize("turned", [False, True])
def test_seams_of_an_obj_stay_though_its_vertices_are_joined_and_its_faces_turned(tmp_path, turned):
    write_obj(tmp_path / "box.obj", unfolded_box(), turned=turned)
    mesh, uv = carried(tmp_path / "box.obj")
    assert len(mesh.vertices) == 8
    np.testing.assert_allclose(uv, expected(mesh), atol=1e-6)


@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_vertices_that_were_split_at_seams_bring_theirs(tmp_path, kind):
    path = tmp_path / f"box.{kind}"
    unfolded_box().export(path)
    mesh, uv = carried(path)
    assert len(mesh.vertices) == 8
    np.testing.assert_allclose(uv, expected(mesh), atol=1e-6)


def test_points_and_lines_beside_a_mesh_have_none(tmp_path):
    strewn = [trimesh.PointCloud(np.eye(3)), trimesh.load_path(np.eye(3)[:2])]
    scene = trimesh.Scene([strewn[0], unfolded_box(), strewn[1]])
    (tmp_path / "box.glb").write_bytes(scene.export(file_type="glb"))
    mesh, uv = carried(tmp_path / "box.glb")
    np.testing.assert_allclose(uv, expected(mesh), atol=1e-6)
    (tmp_path / "strewn.glb").write_bytes(trimesh.Scene(strewn).export(file_type="glb"))
    assert read_texture_coordinates(MeshShape(type="mesh", file=str(tmp_path / "strewn.glb"))) is None


def test_a_cap_goes_on_with_what_its_rim_has(tmp_path):
    write_obj(tmp_path / "open.obj", unfolded_box(), sides=5)
    shape = MeshShape(type="mesh", file=str(tmp_path / "open.obj"), size=EDGE, up="z")
    vertices, faces = merge_vertices(*read_upright_triangles(shape))
    capped, caps = cap_holes(vertices, faces, boundary_loops(faces))
    mesh = TriangleMesh(capped, np.concatenate([faces, caps]).astype(np.int32))
    uv = texture_coordinates(mesh, shape)
    assert uv is not None
    np.testing.assert_allclose(uv[:10], expected(mesh)[:10], atol=1e-6)
    given = uv[:10].reshape(-1, 2)
    assert all((place == given).all(axis=1).any() for place in uv[10:].reshape(-1, 2)), "no place in between"


def test_a_file_without_any_has_none(tmp_path):
    for name in ("plain.obj", "plain.stl", "plain.glb"):
        trimesh.creation.box().export(tmp_path / name)
        assert carried(tmp_path / name)[1] is None


def test_corners_without_any_lie_at_the_lower_left(tmp_path):
    write_obj(tmp_path / "box.obj", unfolded_box())
    text = (tmp_path / "box.obj").read_text()
    last = text.splitlines()[-1]
    bare = " ".join(word.partition("/")[0] for word in last.split())
    (tmp_path / "box.obj").write_text(text.replace(last, bare))
    mesh, uv = carried(tmp_path / "box.obj")
    assert uv is not None
    assert (np.abs(uv - expected(mesh)).max(axis=(1, 2)) > 1e-6).sum() == 1
    assert not uv[np.abs(uv - expected(mesh)).max(axis=(1, 2)) > 1e-6].any()


@pytest.mark.parametrize("bad", ["-nan(ind) 0", "", "nan nan", "1e39 0", "0 -inf", "a b"])
def test_what_cannot_be_read_or_held_lies_at_the_lower_left_and_keeps_its_number(tmp_path, bad):
    write_obj(tmp_path / "box.obj", unfolded_box())
    sound, uv = carried(tmp_path / "box.obj")
    lines = (tmp_path / "box.obj").read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("vt"))
    place = np.float32([float(word) for word in lines[first].split()[1:]])
    lines[first] = f"vt {bad}"
    (tmp_path / "box.obj").write_text("\n".join(lines))
    mesh, told = carried(tmp_path / "box.obj")
    np.testing.assert_array_equal(mesh.vertices, sound.vertices)
    changed = (told != uv).any(axis=2)
    assert changed.sum() == 1
    np.testing.assert_array_equal(uv[changed], [place])
    np.testing.assert_array_equal(told[changed], [[0.0, 0.0]])


@pytest.mark.parametrize("bad", ["nan", "inf", "1e39"])
def test_vertices_whose_coordinates_no_mesh_can_hold_count_as_without_any(tmp_path, bad):
    unfolded_box().export(tmp_path / "box.ply", encoding="ascii")
    assert carried(tmp_path / "box.ply")[1] is not None
    header, end, body = (tmp_path / "box.ply").read_text().partition("end_header\n")
    assert "property double t\nelement face" in header
    first, _, rest = body.partition("\n")
    (tmp_path / "box.ply").write_text(f"{header}{end}{first.rpartition(' ')[0]} {bad}\n{rest}")
    assert carried(tmp_path / "box.ply")[1] is None
