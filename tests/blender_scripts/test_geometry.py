"""The parts of the Blender scripts that are arithmetic; importing them needs the bpy module, in a child process."""

from __future__ import annotations

import pytest
from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy


def test_ply_of_the_projects_writer_reads_back_and_fills_a_blender_mesh(tmp_path):
    run_python(
        """
        import sys
        from pathlib import Path
        import bpy
        import numpy as np
        from blender_scripts.geometry import fill_mesh, read_ply
        from render.meshes import write_ply

        path = Path(sys.argv[1]) / "mesh.ply"
        rng = np.random.default_rng(1)
        vertices, triangles = rng.normal(size=(50, 3)), rng.permuted(np.tile(np.arange(50), (30, 1)), axis=1)[:, :3]
        normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        velocities = rng.normal(size=(50, 3))
        write_ply(path, vertices, triangles, normals=normals, velocities=velocities)
        source = read_ply(path)
        for count in (30, 7):
            # A second, smaller filling leaves nothing of the first.
            part = type(source)(source.vertices, source.faces[:count], source.normals, source.velocities)
            mesh = bpy.data.meshes.get("m") or bpy.data.meshes.new("m")
            fill_mesh(mesh, part)
            assert not mesh.validate(), "Blender had to repair the mesh"
            assert (len(mesh.vertices), len(mesh.polygons)) == (50, count)
            for name, expected in (("position", vertices), ("velocity", velocities), ("custom_normal", normals)):
                values = np.empty(150, np.float32)
                mesh.attributes[name].data.foreach_get("vector", values)
                np.testing.assert_array_equal(values.reshape(50, 3), expected.astype(np.float32))
            corners = np.empty(3 * count, np.int32)
            mesh.loops.foreach_get("vertex_index", corners)
            np.testing.assert_array_equal(corners.reshape(count, 3), triangles[:count])
        """,
        str(tmp_path),
    )


def test_stripping_removes_what_varies_and_keeps_every_pixel(tmp_path):
    from PIL import Image, PngImagePlugin

    from blender_scripts.png import iterate_chunks, strip_metadata

    stamp = PngImagePlugin.PngInfo()
    stamp.add_text("Date", "2026/01/01 00:00:00")
    picture = Image.effect_noise((40, 30), 50)
    picture.save(tmp_path / "stamped.png", pnginfo=stamp)
    picture.save(tmp_path / "plain.png")
    assert (tmp_path / "stamped.png").read_bytes() != (tmp_path / "plain.png").read_bytes()
    strip_metadata(tmp_path / "stamped.png")
    assert (tmp_path / "stamped.png").read_bytes() == (tmp_path / "plain.png").read_bytes()
    with pytest.raises(ValueError, match="truncated"):
        list(iterate_chunks((tmp_path / "plain.png").read_bytes()[:-5]))


def test_poses_that_are_none_are_refused_with_their_file(tmp_path):
    run_python(
        """
        import sys
        from pathlib import Path
        from blender_scripts.errors import RenderInputError
        from blender_scripts.poses import read_poses

        path = Path(sys.argv[1]) / "0.json"
        for text in ('{"version": 1}', '{"version": 1, "bodies": []}', '{"version": 1, "bodies": {"ball": 3}}'):
            path.write_text(text)
            try:
                read_poses(path)
            except RenderInputError as error:
                assert str(error) == f"the poses {path} hold no bodies"
            else:
                raise AssertionError(text)
        """,
        str(tmp_path),
    )
