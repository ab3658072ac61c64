"""Grids of distances of the pieces of what breaks, by which cloth and smoke meet them."""

import numpy as np
import pytest

from sim.shapes import distance_grids
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.cutting import PIECE_CELLS
from sim.shapes.parameters import WeightedPlacement

PANE = {"type": "box", "size": (1.0, 1.0, 0.006)}
BLOCK = {"shape": {"type": "box", "size": (1.0, 1.0, 1.0)}}
PLATE = {"shape": {"type": "box", "size": (0.2, 0.2, 0.004)}, "position": (0.6, 0.0, 0.0), "rotation_deg": (0, 30, 0)}


def piece(number, of, **keys):
    shape = {"type": "piece", "of": of, "number": number, **keys}
    return BodyGeometry(WeightedPlacement(shape=shape, scale=0.5))


@pytest.mark.parametrize("number", [1, 5, 12])
def test_shards_of_a_pane_have_an_inside_on_their_grids(number):
    grid = piece(number, PANE, pieces=12).fine_grid
    assert grid.values.min() < -0.0007  # of 3 mm, two cells
    assert grid.values.size < 4e5


def test_a_thin_plate_of_a_compound_has_an_inside_on_its_grid_and_its_block_is_not_finer():
    compound = {"type": "compound", "part": [BLOCK, PLATE]}
    assert piece(2, compound).fine_grid.values.min() < -0.0004  # of 2 mm
    assert piece(1, compound).fine_grid.spacing > 0.01


def test_sharp_edges_of_shards_are_no_thin_walls():
    shard = piece(3, BLOCK["shape"], pieces=12)
    longest = np.ptp(shard.bounds, axis=0).max()
    assert shard.fine_grid.spacing == pytest.approx(longest / PIECE_CELLS)


def test_grids_of_pieces_are_no_larger_than_memory_holds(monkeypatch):
    monkeypatch.setattr(distance_grids, "MOST_NODES", 20000)
    shell = [(0.0, 0.0), (0.05, 0.0), (0.05, 0.1), (0.049, 0.1), (0.049, 0.001), (0.0, 0.001)]
    assert 10000 < piece(1, {"type": "revolved", "profile": shell}, pieces=4).fine_grid.values.size <= 20000
