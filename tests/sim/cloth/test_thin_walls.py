"""Cloth in a bowl whose walls are thinner than a cell of a grid about the whole bowl."""

import numpy as np
import pytest
import trimesh
from cloth_scenes import EARTH
from contact_scenes import SPACE, cloth_of, world_of

from sim.shapes import distance_grids as shape_grids
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid

RADIUS, WALL = 0.2, 0.008


def write_bowl(path):
    """Half a sphere, open upwards, with its rim at the top of its box."""
    angle = np.linspace(0.0, 0.5 * np.pi, 16)
    arcs = [r * np.stack([np.sin(a), -np.cos(a)], axis=1) for r, a in ((RADIUS, angle), (RADIUS - WALL, angle[::-1]))]
    profile = np.concatenate(arcs)
    profile[[0, -1], 0] = 0.0
    trimesh.creation.revolve(profile, sections=48).export(path)


def nodes_that_left(folder) -> int:
    """Nodes of a sheet, thrown into the bowl at 3 m/s, that come to be outside of it."""
    write_bowl(folder / "bowl.ply")
    sheet = {
        "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (17, 17)},
        "position": (0.01, 0.02, 0.1),
        "velocity": (0.0, 0.0, -3.0),
        "thickness": 0.001,
        "mass_per_area": 0.4,
    }
    bowl = {"shape": {"type": "mesh", "file": str(folder / "bowl.ply")}, "position": (0.0, 0.0, -0.5 * RADIUS)}
    world = world_of(sheet, bodies=[bowl], domain=SPACE, gravity=EARTH)
    for _ in range(10):
        world.advance_frame()
    position = cloth_of(world).state.positions()
    return int(np.count_nonzero(np.linalg.norm(position, axis=1) > RADIUS - 0.5 * WALL))


@pytest.mark.usefixtures("taichi_cpu")
def test_a_bowl_holds_cloth_as_its_grid_is_as_fine_as_its_walls(tmp_path, monkeypatch):
    # A quarter of the usual cells makes the walls half a cell thick, as those of 2 mm would be of the usual.
    monkeypatch.setattr(shape_grids, "CELLS", 24)
    with monkeypatch.context() as coarse:
        coarse.setattr(shape_grids, "CELLS_PER_WALL", 1.0e-6)
        assert nodes_that_left(tmp_path) > 0
    assert nodes_that_left(tmp_path) == 0


def test_cells_are_half_a_thin_wall_and_never_more_than_memory_holds(tmp_path):
    write_bowl(tmp_path / "bowl.ply")
    solid = build_solid(Placement(shape={"type": "mesh", "file": str(tmp_path / "bowl.ply")}, scale=0.5))
    wall = shape_grids.thin_wall(solid)
    assert wall == pytest.approx(0.5 * WALL, rel=0.06)  # facets of its 48 sides are up to 2 % nearer than circles
    assert shape_grids.grid_spacing(solid, wall) == pytest.approx(0.5 * wall)
    assert shape_grids.grid_spacing(solid, np.inf) == pytest.approx(RADIUS / 96)
    finest = shape_grids.grid_spacing(solid, 0.0)
    nodes = np.prod(np.ceil(np.ptp(solid.bounds, axis=0) / finest + 6.0) + 1.0)
    assert 0.9 * shape_grids.MOST_NODES < nodes <= shape_grids.MOST_NODES
