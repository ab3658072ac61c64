"""What presses on the air of closed boxes of smoke is told with its line."""

import pytest
import trimesh
from checked_jobs import PLUME_FROM_A_BALL as PLUME
from checked_jobs import checked

from sim.shapes.mesh_solid import MeshSolid

CLOSED = PLUME.replace("cell_size = 0.02", "cell_size = 0.02\nopen_faces = []")
PISTON = """
[[rigid]]
name = "piston"
kind = "kinematic"
shape = { type = "box", size = [0.5, 0.5, 0.5] }
"""
INFLOW = """
[[fluid]]
name = "water"
particle_radius = 0.012
[[fluid.emitter]]
shape = { type = "disc", radius = 0.05 }
position = [-0.3, 0.0, 0.8]
direction = [0.0, 0.0, -1.0]
speed = 1.5
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            CLOSED + PISTON + "position = [-0.76, 0.0, 0.5]\nvelocity = [0.5, 0.0, 0.0]\n",
            ("rigid[0]: comes into", '"plume"', "about 12 %", "must flow out", "open_faces"),
        ),
        (
            CLOSED + PISTON + "position = [-0.24, 0.0, 0.5]\nvelocity = [-0.52, 0.0, 0.0]\n",
            ("rigid[0]: leaves", '"plume"', "about 12 %", "must flow in", "open_faces"),
        ),
        (CLOSED + INFLOW, ("fluid[0].emitter[0]: fills", '"plume"', "about 1.2 %", "must flow out", "open_faces")),
    ],
)
def test_what_presses_on_the_air_of_a_closed_box_is_told(text, expected, tmp_path):
    (warning,) = checked(text, tmp_path / "closed.toml").warnings
    assert all(part in warning for part in expected)


@pytest.mark.parametrize(
    "text",
    [
        # Through an open side as much flows out.
        PLUME + PISTON + "position = [-0.76, 0.0, 0.5]\nvelocity = [0.5, 0.0, 0.0]\n",
        PLUME + INFLOW,
        # It stays inside, or as far outside as it is.
        CLOSED + PISTON + "position = [0.1, 0.0, 0.6]\nvelocity = [0.1, 0.0, 0.0]\n",
        CLOSED + PISTON + "position = [-0.2, 0.0, 0.0]\nvelocity = [0.4, 0.0, 0.0]\n",
        # It turns in the wall, as much of it inside as before.
        CLOSED + PISTON + "position = [0.0, 0.0, 0.0]\nangular_velocity = [1.6, 0.0, 0.0]\n",
        # It begins after the film.
        CLOSED + INFLOW + "start_s = 2.0\n",
        # It ends after 50 particles of 13.8 cm³ each, 0.07 % of the box.
        CLOSED + INFLOW.replace("particle_radius = 0.012", "particle_radius = 0.012\nmax_particles = 50"),
    ],
)
def test_air_that_keeps_its_room_passes_without_a_word(text, tmp_path):
    warnings = checked(text, tmp_path / "closed.toml").warnings
    assert not [each for each in warnings if "no side of that is open" in each]


@pytest.mark.parametrize(
    ("motion", "share"),
    [
        ("position = [0.0, 0.0, 0.5]\nvelocity = [0.1, 0.0, 0.0]\n", None),
        ("position = [-0.8, 0.0, 0.5]\nvelocity = [0.6, 0.0, 0.0]\n", "6.4 %"),
        ("position = [-0.8, 0.0, 0.5]\nvelocity = [0.6, 0.0, 0.0]\nangular_velocity = [1.6, 0.0, 0.0]\n", "6.4 %"),
    ],
)
def test_of_a_mesh_only_the_hull_is_looked_at_in_each_moment(motion, share, tmp_path, monkeypatch):
    fine = trimesh.creation.box((0.4, 0.4, 0.4)).subdivide().subdivide().subdivide().subdivide()
    fine.export(tmp_path / "block.obj")
    looks, support = [], MeshSolid.support

    def counted(solid, axes):
        looks.append(len(solid.mesh.vertices))
        return support(solid, axes)

    monkeypatch.setattr(MeshSolid, "support", counted)
    block = PISTON.replace('{ type = "box", size = [0.5, 0.5, 0.5] }', '{ type = "mesh", file = "block.obj" }')
    path = tmp_path / "closed.toml"
    told = [each for each in checked(CLOSED + block + motion, path).warnings if "comes into the box" in each]
    assert len(told) == (share is not None)
    assert all(f"about {share}" in each for each in told)
    assert sum(looks) < 50 * len(fine.vertices)
