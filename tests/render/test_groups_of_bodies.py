"""Bodies of a group in Blender: one mesh and one material, and a grain and shade of its own for each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import draw_all, spec_of
from needed_blender import needs_bpy
from warm_python import run_python

from render.meshes import write_ply
from render.parameters import MaterialParameters
from render.spec import MeshObject, RenderSpec
from sim.shapes.primitives import Box

pytestmark = needs_bpy

PLACES = {"plank_1": -0.35, "plank_2": 0.35}
SIZE = (0.5, 0.1, 0.6)


def planks(folder: Path, look: str, *names: str) -> RenderSpec:
    """Planks that are seen from the front, in scenes that are lit alike."""
    mesh = Box(SIZE).surface_mesh(None)
    write_ply(folder / "plank_1.ply", mesh.vertices, mesh.faces)
    material = MaterialParameters.model_validate({"look": look})
    objects = [
        MeshObject(name=name, file="plank_1.ply", position=(PLACES[name], 0.0, 0.5), material=material)
        for name in names
    ]
    return spec_of(*objects, samples=16, motion_blur=False, resolution=(128, 72))


def front(picture: np.ndarray, name: str) -> np.ndarray:
    """The middle of the front of a plank."""
    column = 64 + round(PLACES[name] * 128 * 50.0 / 36.0 / 2.5)
    return picture[26:46, column - 12 : column + 12]


@pytest.mark.parametrize("look", ["wood", "stone"])
def test_bodies_of_a_group_differ_in_grain_as_bodies_of_their_names_do(tmp_path, look):
    (both,) = draw_all(tmp_path, planks(tmp_path, look, *PLACES))
    alone = {name: draw_all(tmp_path, planks(tmp_path, look, name))[0] for name in PLACES}

    def unlike(first: np.ndarray, second: np.ndarray) -> float:
        return float(np.abs(first - second).mean())

    differ = unlike(front(both, "plank_1"), front(both, "plank_2"))
    assert differ > 8.0  # of 255
    for name in PLACES:
        # But for the light that the other plank sends, and the noise of sixteen samples.
        assert unlike(front(both, name), front(alone[name], name)) < 0.3 * differ


def test_bodies_of_a_group_share_mesh_and_material_and_others_do_not(tmp_path):
    spec = planks(tmp_path, "wood", *PLACES)
    red = MaterialParameters.model_validate({"look": "wood", "color": [0.5, 0.1, 0.1]})
    other = MeshObject(name="plank_3", file="plank_1.ply", material=red)
    spec.model_copy(update={"objects": (*spec.objects, other)}).write(tmp_path / "spec.json")
    run_python(
        """
        import sys
        from pathlib import Path
        import bpy
        from blender_scripts.render_frames import SceneRenderer
        from blender_scripts.shading import own_numbers
        SceneRenderer(Path(sys.argv[1]), threads=1, gpu=None)
        one, two, other = (bpy.data.objects[f"plank_{number}"] for number in (1, 2, 3))
        assert one.data == two.data and one.data.users == 2, one.data.users
        assert other.data != one.data and other.data.materials[0] != one.data.materials[0]
        assert len(one.data.materials) == 1
        assert list(one["own_numbers_2"])[:2] == own_numbers("plank_1", 2)
        assert list(one["own_numbers_2"]) != list(two["own_numbers_2"])
        """,
        str(tmp_path / "spec.json"),
    )
