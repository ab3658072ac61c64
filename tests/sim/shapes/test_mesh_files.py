"""Mesh files: the formats, `up`, `size`, centring, and every way a file can be wrong."""

import json

import numpy as np
import pytest
import trimesh

from sim.shapes.mesh_file import read_texture_coordinates, read_triangles
from sim.shapes.parameters import MeshShape, Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import ShapeError


def write_wedge(path):
    """An off-centre, asymmetric solid: a box of 1 x 2 x 3 m with one corner cut off."""
    wedge = trimesh.convex.convex_hull(
        [[x, y, z] for x in (4, 5) for y in (0, 2) for z in (0, 3) if (x, y, z) != (5, 2, 3)] + [[4.5, 2, 3], [5, 2, 1]]
    )
    wedge.export(path)
    return wedge


def mesh_solid(path, **options):
    return build_solid(Placement(shape={"type": "mesh", "file": str(path), **options}))


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_every_format_gives_the_same_solid(tmp_path, suffix):
    wedge = write_wedge(tmp_path / f"wedge.{suffix}")
    solid = mesh_solid(tmp_path / f"wedge.{suffix}")
    np.testing.assert_allclose(solid.bounds, [[-0.5, -1.0, -1.5], [0.5, 1.0, 1.5]], atol=1e-6)  # files hold float32
    assert solid.volume == pytest.approx(wedge.volume, rel=1e-6)
    assert solid.surface_mesh().is_closed
    assert solid.warnings == ()


def test_objects_of_a_scene_are_placed_and_joined(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 3.0):
        scene.add_geometry(
            trimesh.creation.box((1, 1, 1)), transform=trimesh.transformations.translation_matrix([x, 0, 0])
        )
    scene.export(tmp_path / "pair.glb")
    solid = mesh_solid(tmp_path / "pair.glb")
    np.testing.assert_allclose(np.ptp(solid.bounds, axis=0), [4.0, 1.0, 1.0], atol=1e-6)
    np.testing.assert_array_equal(
        solid.signed_distance(np.array([[-1.5, 0, 0], [0, 0, 0], [1.5, 0, 0]])) < 0, [1, 0, 1]
    )


SEAMS = """\
o left
v 0 0 0
v 1 0 0
v 9 9 9
v 0 1 0
v 1 1 0
vt 0 0
vt 0.4 0
vt 0.4 1
vt 0 1
vn 0 0 1
usemtl red
f 1/1/1 2/2/1 \\
  5/3/1 4/4/1
o right
v 2 0 0
v 2 1 0
vt 0.6 0
vt 0.6 1
usemtl blue
f -6//1 -2//1 -1//1
f 2/5 7/6 5/6
"""
"""Two squares that share an edge, where their texture coordinates, materials and objects differ; vertex 2 is unused."""


def test_seams_objects_and_materials_leave_the_numbers_of_an_obj_as_they_are(tmp_path):
    (tmp_path / "seams.obj").write_text(SEAMS)
    vertices, faces = read_triangles(tmp_path / "seams.obj")
    expected = [[0, 0, 0], [1, 0, 0], [9, 9, 9], [0, 1, 0], [1, 1, 0], [2, 0, 0], [2, 1, 0]]
    np.testing.assert_array_equal(vertices, expected)
    np.testing.assert_array_equal(faces, [[0, 1, 4], [0, 4, 3], [1, 5, 6], [1, 6, 4]])


@pytest.mark.parametrize(
    "text",
    [
        "{}f 1 2 3 # 4\nf 1 3 4 #left side\n",
        "# from C:\\models\\\n{}f 1 2 3\nf 1 3 4\n",
        "{}f 1 2 3\nf 1 3 \\\n4 \\\n",
        "{}f 1 2 3\nf 1 3 4 \\",
        "\ufeff{}f 1 2 3\nf 1 3 4\n",
    ],
    ids=["comments", "comment with a backslash", "backslash and line end", "backslash at the end", "byte order mark"],
)
def test_every_vertex_and_face_of_an_obj_is_read(tmp_path, text):
    (tmp_path / "square.obj").write_text(text.format("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"), encoding="utf-8")
    vertices, faces = read_triangles(tmp_path / "square.obj")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3]])


DART = ((0.0, 0.0), (2.0, 0.0), (1.0, 0.5), (1.0, 2.0))
"""Its third corner points inwards: triangles about that one, or the first, fill it."""


def write_polygon(path, corners, first):
    turned = corners[first:] + corners[:first]
    text = "".join(f"v {x} {y} 0\n" for x, y in turned)
    path.write_text(f"{text}f {' '.join(str(k + 1) for k in range(len(turned)))}\n")


def test_polygons_that_a_fan_fills_are_read_though_they_are_concave_or_have_corners_on_a_line(tmp_path):
    on_a_line = ((0.0, 0.0), (0.5, 1e-6), (1.0, -1e-6), (1.5, 0.0), (1.5, 1.0))
    for corners, first, area in ((DART, 0, 1.25), (DART, 2, 1.25), (on_a_line, 0, 0.75), (on_a_line, 3, 0.75)):
        write_polygon(tmp_path / "polygon.obj", corners, first)
        vertices, faces = read_triangles(tmp_path / "polygon.obj")
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        # Corners that are a millionth off the line make triangles that are as thin.
        assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(area, abs=1e-5)


@pytest.mark.parametrize("first", [1, 3])
def test_polygons_that_a_fan_does_not_fill_are_refused(tmp_path, first):
    write_polygon(tmp_path / "dart.obj", DART, first)
    with pytest.raises(ShapeError, match=r"dart.obj.*line 5: a concave polygon, which triangles about its first"):
        read_triangles(tmp_path / "dart.obj")


def test_texture_coordinates_of_corners_do_not_renumber_a_ply(tmp_path):
    (tmp_path / "seam.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n1 1 0\n3 1 3 2 6 0 0 1 0 1 1\n3 0 1 2 6 5 5 6 5 6 6\n"
    )
    vertices, faces = read_triangles(tmp_path / "seam.ply")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(faces, [[1, 3, 2], [0, 1, 2]])


PLY = (
    "ply\nformat ascii 1.0\ncomment TextureFile somebody.png\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
)


def test_a_ply_whose_comment_names_a_picture_is_read_without_it(tmp_path, caplog, capfd):
    (tmp_path / "corner.ply").write_text(PLY.format(faces=4))
    shape = MeshShape(type="mesh", file=str(tmp_path / "corner.ply"))
    assert len(read_triangles(tmp_path / "corner.ply")[1]) == 4
    assert read_texture_coordinates(shape) is None
    assert caplog.records == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("faces", [5, 4_000_000_000, -1])
def test_a_ply_that_has_fewer_faces_than_it_announces_is_refused(tmp_path, faces):
    (tmp_path / "cut.ply").write_text(PLY.format(faces=faces))
    with pytest.raises(ShapeError, match=r"cut.ply\" is not a readable PLY file"):
        read_triangles(tmp_path / "cut.ply")


def test_y_up_turns_the_file_upright(tmp_path):
    trimesh.creation.cone(
        radius=0.5, height=2.0, transform=trimesh.geometry.align_vectors([0, 0, 1], [0, 1, 0])
    ).export(tmp_path / "cone.obj")
    solid = mesh_solid(tmp_path / "cone.obj", up="y")
    np.testing.assert_allclose(np.ptp(solid.bounds, axis=0), [1.0, 1.0, 2.0], atol=1e-6)
    near_base, near_tip = solid.signed_distance(np.array([[0.3, 0.0, -0.9], [0.3, 0.0, 0.9]]))
    assert near_base < 0.0 < near_tip


def test_size_sets_the_longest_edge_and_scale_multiplies_it(tmp_path):
    write_wedge(tmp_path / "wedge.ply")
    placement = Placement(shape={"type": "mesh", "file": str(tmp_path / "wedge.ply"), "size": 0.6}, scale=2.0)
    np.testing.assert_allclose(np.ptp(build_solid(placement).bounds, axis=0), [0.4, 0.8, 1.2], rtol=1e-6)


def test_max_edge_refines_without_opening_the_mesh(tmp_path):
    write_wedge(tmp_path / "wedge.stl")
    solid = mesh_solid(tmp_path / "wedge.stl")
    mesh = solid.surface_mesh(max_edge=0.25)
    assert np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2).max() <= 0.25
    assert mesh.is_closed
    assert mesh.signed_volume == pytest.approx(solid.volume, rel=1e-12)


def test_max_edge_cuts_long_edges_alone(tmp_path):
    """Triangles of a needle become three, not four, where their two long edges are halved, nine times."""
    trimesh.creation.box((0.001, 0.001, 1.0)).export(tmp_path / "needle.stl")
    mesh = mesh_solid(tmp_path / "needle.stl").surface_mesh(max_edge=0.002)
    assert np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2).max() <= 0.002
    assert mesh.is_closed
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert len(mesh.faces) < 12 * 3**9
    assert mesh.signed_volume == pytest.approx(1.0e-6, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.obj", None, r'shape.file: must be a mesh file, ".*none.obj" does not exist; check the path'),
        ("notes.txt", b"hello", r"must be an OBJ, PLY, STL or GLB file, got \"notes.txt\"; export it as GLB"),
        ("bad.glb", b"garbage", r"is not a readable GLB file \(.+\); export it again"),
        ("bad.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n", "PLY file|has no faces"),
        ("cut.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cut.obj.* has faces that name vertices it does not have"),
        ("back.obj", b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\n", r'line 3, "f -1 -2 -3": a face names vertex -3; 2 are there'),
        ("zero.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "a face names vertex 0; 3 are there, numbered from 1"),
        ("line.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\nf 1 2 3\n", r'4, "f 1 2": a face needs three corners .* 2'),
        ("short.obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", r'not a readable OBJ file .*line 2, "v 1 0"'),
        ("empty.obj", b"", "empty.obj.* (has no faces|is not a readable OBJ)"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "points.obj has no faces; a solid needs a surface"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "nan.obj has 1 vertices that are not finite"),
        ("dot.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "dot.obj has no extent"),
    ],
)
def test_unusable_file_is_refused_by_name(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ShapeError, match=message):
        mesh_solid(tmp_path / name, size=0.5)


@pytest.mark.parametrize("suffix", ["gltf", "off"])
def test_formats_that_a_copy_of_one_file_may_not_hold_are_refused(tmp_path, suffix):
    written = write_wedge(tmp_path / "wedge.stl").export(file_type=suffix)
    for name, content in (written if suffix == "gltf" else {"wedge": written}).items():
        path = tmp_path / (f"wedge.{suffix}" if name in ("wedge", "model.gltf") else name)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ShapeError, match=f'got "wedge.{suffix}"; export it as GLB'):
        mesh_solid(tmp_path / f"wedge.{suffix}")


def test_a_glb_that_keeps_its_triangles_in_a_file_beside_it_is_refused(tmp_path):
    write_wedge(tmp_path / "wedge.glb")
    whole = (tmp_path / "wedge.glb").read_bytes()
    json_length = int.from_bytes(whole[12:16], "little")
    tree = json.loads(whole[20 : 20 + json_length])
    (tmp_path / "wedge.bin").write_bytes(whole[20 + json_length + 8 :])
    tree["buffers"][0]["uri"] = "wedge.bin"
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text
    (tmp_path / "wedge.glb").write_bytes(b"glTF" + whole[4:8] + (12 + len(chunk)).to_bytes(4, "little") + chunk)
    with pytest.raises(ShapeError, match="is not a readable GLB file"):
        mesh_solid(tmp_path / "wedge.glb")
