"""What the cells of a smoke miss of a body, where geometry says it."""

import numpy as np
import pytest
import trimesh

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import SmokeParameters
from sim.smoke.thin_walls import PROBES, thin_walls, thin_walls_on_the_way

DOMAIN = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
SOURCE = {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.2)}
AIR = SmokeParameters(name="air", source=[SOURCE], cell_size=0.02)
NOISE = 3.0 * 0.5 / np.sqrt(PROBES)
"""Three standard deviations of a share that is counted at so many points."""


def placed(shape: dict, position=(0.0, 0.0, 0.5), rotation_deg=(0.0, 0.0, 0.0)):
    return build_solid(Placement(shape=shape, position=position, rotation_deg=rotation_deg))


def plate(thickness: float, **where):
    """Farther across than the box."""
    return placed({"type": "box", "size": (3.0, 3.0, thickness)}, **where)


def is_tight(solid) -> bool:
    """Whether no air gets from below to above it, from cell to cell through faces."""
    number = SmokeGrid.build(AIR, DOMAIN, [solid]).air_regions()
    return number[25, 25, 2] != number[25, 25, 47]


@pytest.mark.parametrize("thickness", [0.008, 0.012, 0.019])
def test_of_a_turned_plate_cells_miss_what_its_thickness_leaves_of_a_column(thickness):
    solid = plate(thickness, rotation_deg=(20.0, 12.0, 0.0))
    # A column along z crosses it over d / n_z, and holds a corner every 0.02 m.
    normal_z = np.cos(np.deg2rad(20.0)) * np.cos(np.deg2rad(12.0))
    expected = max(0.0, 1.0 - thickness / normal_z / 0.02)
    found = thin_walls(solid, AIR, DOMAIN)
    assert found.share == pytest.approx(expected, abs=NOISE)
    assert is_tight(solid) == (expected == 0.0) == (found.share == 0.0)
    if expected:
        assert found.thickness == pytest.approx(thickness, rel=0.01)


def test_a_thin_plate_along_a_layer_of_corners_is_seen_whole():
    solid = plate(0.01, position=(0.0, 0.0, 0.5))
    assert is_tight(solid)
    assert thin_walls(solid, AIR, DOMAIN).share == 0.0


def test_the_rim_that_cells_cut_off_a_small_plate_is_no_hole():
    """From -0.15 to 0.15 m, of which cells of 0.04 m show what is between -0.14 and 0.14 m."""
    small = placed({"type": "box", "size": (0.3, 0.3, 0.03)}, position=(0.0, 0.0, 0.48))
    assert thin_walls(small, AIR.model_copy(update={"cell_size": 0.04}), DOMAIN).share == 0.0


def test_a_slab_on_a_closed_side_lets_nothing_through():
    slab = plate(0.016, position=(0.0, 0.0, 0.0))  # 8 mm of it in the box, with the corners in the side
    assert thin_walls(slab, AIR, DOMAIN).share == 0.0
    open_below = AIR.model_copy(update={"open_faces": ("z-",)})
    assert thin_walls(slab, open_below, DOMAIN).share == 0.0
    assert not SmokeGrid.build(open_below, DOMAIN, [slab]).open_area[2][..., 0].any()
    above = plate(0.016, position=(0.0, 0.0, 0.01))  # between the side and the next corners
    assert thin_walls(above, AIR, DOMAIN).share == 0.0
    assert thin_walls(above, open_below, DOMAIN).share == 1.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A closed room whose walls are 1 cm thick."""
    outer, inner = trimesh.creation.box((0.5, 0.5, 0.5)), trimesh.creation.box((0.48, 0.48, 0.48))
    inner.invert()
    path = tmp_path_factory.mktemp("meshes") / "room.obj"
    trimesh.util.concatenate([outer, inner]).export(path)
    return {"type": "mesh", "file": str(path)}


def test_of_a_hollow_mesh_its_walls_count_and_not_its_box(room):
    solid = placed(room, position=(0.005, 0.003, 0.5))
    number = SmokeGrid.build(AIR, DOMAIN, [solid]).air_regions()
    assert number[25, 25, 25] == number[1, 1, 1]  # smoke leaves the room
    found = thin_walls(solid, AIR, DOMAIN)
    assert found.share > 0.4
    assert found.thickness == pytest.approx(0.01, rel=0.01)
    finer = AIR.model_copy(update={"cell_size": 0.0099})
    assert thin_walls(solid, finer, DOMAIN).share == 0.0


@pytest.mark.parametrize("cell_size", [0.01, 0.02, 0.04])
@pytest.mark.parametrize(
    "shape",
    [
        {"type": "box", "size": (0.2, 0.2, 0.2)},
        {"type": "sphere", "radius": 0.1},
        {"type": "cone", "radius": 0.1, "height": 0.2},
        {"type": "torus", "major_radius": 0.1, "minor_radius": 0.03},
    ],
)
def test_bodies_of_five_cells_across_are_thick_but_for_their_edges(shape, cell_size):
    smoke = AIR.model_copy(update={"cell_size": cell_size})
    solid = placed(shape, position=(0.013, 0.004, 0.51), rotation_deg=(20.0, 12.0, 5.0))
    assert thin_walls(solid, smoke, DOMAIN).share < 0.05
    assert thin_walls_on_the_way(solid, smoke).share < 0.05


def test_what_is_missed_of_a_moving_body_does_not_depend_on_where_it_starts(room):
    """Of walls half as thick as cells, along the grid, half a column in three places: one place or two of three."""
    shares = {thin_walls_on_the_way(placed(room, position=(x, 0.0, 0.5)), AIR).share for x in (0.0, 0.004, 0.009)}
    assert all(0.3 < share < 0.7 for share in shares)
