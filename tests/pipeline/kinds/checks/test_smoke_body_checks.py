"""Bodies that the cells of a smoke cannot show, told with their lines."""

import numpy as np
import pytest
import trimesh
from checked_jobs import PLUME_FROM_A_BALL as PLUME
from checked_jobs import checked, says

from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

PLATE = """
[[rigid]]
name = "plate"
shape = { type = "box", size = [0.9, 0.9, 0.01] }
position = [0.0, 0.0, 0.5]
"""
BETWEEN = PLATE.replace("0.0, 0.5]", "0.0, 0.51]")  # the corners of cells
TURNED = "rotation_deg = [20.0, 12.0, 0.0]\n"


def test_a_flat_static_plate_between_the_cells_is_refused_with_its_name(tmp_path):
    (error,) = checked(PLUME + BETWEEN, tmp_path / "flat.toml").errors
    assert says(error, 'flat.toml:15 rigid[0]: is 0.01 m thin ... between the cells of smoke "plume", 0.02 m')


@pytest.mark.parametrize(
    ("changes", "body"),
    [
        # A pane that begins where the box ends, but for 6e-17 m.
        (
            "cell_size = 0.02\nmin = [-0.5, -0.5, 0.0]\nmax = [0.5, 0.5, 1.0]",
            PLATE.replace("0.9, 0.9, 0.01", "0.005, 1, 1").replace("[0.0, 0.0, 0.5]", "[0.5025, 0.0, 0.5]"),
        ),
        # 8 mm of it are above a closed floor, below the first centres.
        ("cell_size = 0.02", PLATE.replace("0.01]", "0.016]").replace("[0.0, 0.0, 0.5]", "[0.0, 0.0, 0.0]")),
    ],
)
def test_a_thin_plate_in_a_side_of_the_box_passes_without_a_word(changes, body, tmp_path):
    wide = PLUME.replace("[-0.5, -0.5, 0.0]", "[-0.6, -0.6, 0.0]").replace("[0.5, 0.5, 1.0]", "[0.6, 0.6, 1.0]")
    found = checked(wide.replace("cell_size = 0.02", changes) + body, tmp_path / "side.toml")
    assert [*found.errors, *found.warnings] == []


def test_wind_past_such_a_plate_is_one_error(tmp_path):
    windy = PLUME.replace("cell_size = 0.02", "cell_size = 0.02\nwind = [1.0, 0.0, 0.0]")
    assert len(checked(windy + BETWEEN, tmp_path / "flat.toml").errors) == 1


def test_a_static_plate_that_leaks_is_told_with_the_cells_that_would_not(tmp_path):
    found = checked(PLUME + PLATE + TURNED, tmp_path / "leak.toml")
    assert found.errors == []
    (warning,) = found.warnings
    assert says(warning, 'leak.toml:15 rigid[0]: has walls thinner ... "plume", 0.02 m ... cell_size of 0.01 m or less')
    finer = (PLUME + PLATE + TURNED).replace("cell_size = 0.02", "cell_size = 0.01")
    assert checked(finer, tmp_path / "fine.toml").warnings == []


def test_a_flat_body_on_a_thick_one_passes_without_a_word(tmp_path):
    table = PLATE.replace("0.9, 0.9, 0.01", "0.9, 0.9, 0.1").replace("0.0, 0.5]", "0.0, 0.257]")
    cone = PLATE.replace('{ type = "box", size = [0.9, 0.9, 0.01] }', '{ type = "cone", radius = 0.3, height = 0.03 }')
    cone = cone.replace("plate", "cone").replace("0.0, 0.5]", "0.0, CENTRE]")
    centre = 0.307 - build_solid(Placement(shape={"type": "cone", "radius": 0.3, "height": 0.03})).bounds[0, 2]
    plume = PLUME.replace("[0.0, 0.0, 0.2]", "[0.0, 0.0, 0.7]")
    assert checked(plume + table + cone.replace("CENTRE", f"{centre}"), tmp_path / "on.toml").warnings == []
    (warning,) = checked(plume + cone.replace("CENTRE", f"{centre}"), tmp_path / "off.toml").warnings
    assert "has walls thinner than the cells" in warning


@pytest.mark.parametrize(
    "motion", ["", 'kind = "kinematic"\nvelocity = [0.1, 0.0, 0.0]\n', 'kind = "dynamic"\ndensity = 500.0\n']
)
def test_a_room_with_thin_walls_is_told_whether_it_moves_or_not(motion, tmp_path):
    outer, inner = trimesh.creation.box((0.5, 0.5, 0.5)), trimesh.creation.box((0.48, 0.48, 0.48))
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "room.obj")
    room = f'[[rigid]]\nname = "room"\nshape = {{ type = "mesh", file = "room.obj" }}\nposition = [0, 0, 0.5]\n{motion}'
    (warning,) = checked(PLUME + room, tmp_path / "room.toml").warnings
    assert "rigid[0]: has walls thinner than the cells" in warning


@pytest.mark.parametrize(("wall", "is_told"), [(0.02, True), (0.06, False)])
def test_walls_of_a_cell_that_the_grid_of_a_large_mesh_cannot_feel_are_told(wall, is_told, tmp_path):
    """Of a cube of 4 m it has cells of 4 m / 250."""
    inner = trimesh.creation.box(np.full(3, 4.0 - 2.0 * wall))
    inner.invert()
    trimesh.util.concatenate([trimesh.creation.box((4.0, 4.0, 4.0)), inner]).export(tmp_path / "hall.obj")
    hall = '[[rigid]]\nname = "hall"\nkind = "kinematic"\nshape = { type = "mesh", file = "hall.obj" }\n'
    hall += "position = [0, 0, 0.5]\nvelocity = [0.1, 0, 0]\n"
    told = [line for line in checked(PLUME + hall, tmp_path / "hall.toml").warnings if "air may pass" in line]
    assert len(told) == is_told
    assert all('the finest grid that smoke "plume" may meet it by has cells of 0.016' in line for line in told)


@pytest.mark.parametrize(
    "changes",
    [
        "cell_size = 1e-6",
        "cell_size = 0.02\nmin = [0.0, 0.0, 0.495]\nmax = [0.1, 0.1, 0.3]",
        # A thousandth of a layer is a layer: 10¹² cells.
        "cell_size = 1e-3\nmin = [-500, -500, 0.5]\nmax = [500, 500, 0.500001]",
        "cell_size = 0.3",
    ],
)
def test_of_a_grid_that_cannot_be_only_its_size_is_told(changes, tmp_path):
    """It is not built to look for bodies in it."""
    found = checked(PLUME.replace("cell_size = 0.02", changes) + PLATE, tmp_path / "size.toml")
    assert any("smoke[0]" in each for each in found.errors)
    assert not any("rigid[0]" in each for each in [*found.errors, *found.warnings])
