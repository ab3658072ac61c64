"""Water is an obstacle for the air."""

import numpy as np
import pytest
from half_full_rooms import SILENT_SOURCE, SPACING, HalfFullRoom, lattice
from smoke_scenes import with_blocks

from sim.core.domain import DomainParameters
from sim.coupling.smoke_fluid import room_for_water
from sim.smoke.grid import SmokeGrid

pytestmark = pytest.mark.usefixtures("taichi_cpu")

EARTH = (0.0, 0.0, -9.81)
TANK = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.24, 0.24, 0.4), open_faces=("z+",))


CELLS_IN_SPACINGS = [1.0, *(pytest.param(size, marks=pytest.mark.slow) for size in (0.5, 2.0, 4.0))]
"""Compiling the kernels of a room takes seconds."""


@pytest.fixture(scope="module", params=CELLS_IN_SPACINGS, ids=lambda spacings: f"cells of {spacings:g} spacings")
def room(request, taichi_cpu) -> HalfFullRoom:
    """A smoke with a box that is larger than the tank, whose walls do not hold the air."""
    return HalfFullRoom(
        lattice(TANK.min, (0.24, 0.24, 0.24)),
        domain=TANK,
        cell_size=request.param * SPACING,
        min=(-0.103, -0.103, -0.103),
        max=(0.34, 0.34, 0.4),
    )


def test_a_tank_holds_water_up_to_its_surface_without_holes_whatever_the_size_of_cells(room):
    """Particles are out of place by up to a fifth of their spacing, as they are in moving water."""
    level, size = 0.24, room.smoke.grid.cell_size
    water = lattice(TANK.min, (0.24, 0.24, level))
    water += np.random.default_rng(3).uniform(-0.2, 0.2, water.shape) * SPACING
    room.place(water)
    centre = room.smoke.grid.cell_centres().reshape(*room.smoke.grid.cells, 3)
    inside = ((centre > TANK.min) & (centre < TANK.max)).all(axis=-1)
    height, is_water = centre[..., 2], room.is_water()
    # Within half a cell of the surface either is right; all below is water, up to edges and corners.
    assert is_water[inside & (height < level - 0.5001 * size)].all()
    assert not is_water[~inside | (height > level + 0.5001 * size)].any()


def test_single_drops_do_not_block_the_air(room):
    room.place(
        np.array([[0.05, 0.05, 0.1], [0.05, 0.15, 0.11], [0.15, 0.15, 0.2], [0.2, 0.05, 0.31], [0.22, 0.05, 0.31]])
    )
    assert not room.is_water().any()


@pytest.mark.parametrize("reach_in_cells", [1.0, 1.7, 4.0])
def test_beside_a_static_body_water_is_made_up_for_as_beside_a_wall(reach_in_cells):
    size, floor = 0.02, 5
    solid = np.zeros((12, 12, 12), bool)
    solid[..., :floor] = True
    reach = reach_in_cells * size
    sides = ("x-", "x+", "y-", "y+", "z-", "z+")
    open_domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.24, 0.24, 0.24), open_faces=sides)
    tank = DomainParameters(min=(0.0, 0.0, floor * size), max=(0.24, 0.24, 0.24), open_faces=tuple(set(sides) - {"z-"}))
    empty = SmokeGrid.of_cells((0.0, 0.0, 0.0), size, solid.shape, frozenset())
    beside_body = room_for_water(with_blocks(empty, solid), open_domain, reach)
    beside_wall = room_for_water(empty, tank, reach)
    assert beside_wall[5, 5, floor] < 0.9
    # Cells beside the sides of the box do not know of the body beyond; walls are in single precision.
    inner = slice(4, -4)
    np.testing.assert_allclose(beside_body[inner, inner, floor:], beside_wall[inner, inner, floor:], atol=1.0e-6)


@pytest.mark.slow
def test_water_at_rest_is_a_wall_for_rising_and_sinking_smoke_and_holds_none():
    """Cold smoke falls onto the surface from above, and spreads."""
    source = {"shape": {"type": "sphere", "radius": 0.05}, "position": (0.12, 0.12, 0.3), "temperature": 200.0}
    room = HalfFullRoom(
        lattice(TANK.min, (0.24, 0.24, 0.16)),
        domain=TANK,
        cell_size=SPACING,
        source=source,
        buoyancy_density=5.0,
        air_gravity=EARTH,
    )
    time_s = 0.0
    while time_s < 0.6:
        time_s += room.step(still=True)
    surface = 8
    np.testing.assert_array_equal(np.flatnonzero(room.is_water().any(axis=(0, 1))), np.arange(surface))
    # Nothing crosses the faces of the surface: exactly, as they are closed and water is at rest.
    assert not room.faces(2)[..., : surface + 1].any()
    snapshot = room.smoke.snapshots()["air"].arrays
    assert not snapshot["density"][..., :surface].any()
    assert snapshot["density"][..., surface].max() > 0.3
    assert np.abs(room.faces(0)[..., surface]).max() > 0.1


def test_a_block_of_water_that_comes_in_drives_as_much_air_out():
    """It comes down through the open top at 1 m/s; air leaves around it, and through an open side."""
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.32, 0.32, 0.8), open_faces=("z+",))
    block = lattice((0.08, 0.08, 0.34), (0.24, 0.24, 0.74))
    room = HalfFullRoom(
        block,
        domain=domain,
        cell_size=SPACING,
        velocity=(0.0, 0.0, -1.0),
        max=(0.32, 0.32, 0.32),
        open_faces=("z+", "x+"),
        source={**SILENT_SOURCE, "position": (0.16, 0.16, 0.16)},
    )
    # It moves a cell in a step at most, though none of it is in the box yet.
    assert room.coupling.stable_dt() == pytest.approx(SPACING / 1.0, rel=1.0e-6)
    time_s = 0.0
    while time_s < 0.12:
        time_s += room.step()
    is_water, area = room.is_water(), SPACING**2
    outflow = float(room.faces(2)[..., -1][~is_water[..., -1]].sum() + room.faces(0)[-1].sum()) * area
    # The section of the block, 8 x 8 cells, times its speed. The projection leaves 1e-5 of the speed in each cell.
    assert outflow == pytest.approx(0.16**2 * 1.0, rel=1.0e-3)
    # What has come in since it touched the top, by particles and by cells: the front is within half a cell.
    volume = float(np.count_nonzero(is_water)) * SPACING**3
    came_in = np.count_nonzero(room.fluid.particles.position.to_numpy()[: len(block), 2] < 0.32) * SPACING**3
    assert abs(volume - came_in) < 0.5001 * SPACING * 0.16**2
    assert not room.smoke.snapshots()["air"].arrays["density"][is_water].any()
    # A particle far above has the way to the box to go first, but for the two spacings that it reaches.
    room.place(np.array([[0.16, 0.16, 0.7]]))
    assert room.coupling.stable_dt() == np.inf
    room.fluid.particles.velocity.fill(2.0)
    way = 0.7 - (0.32 + 2.0 * SPACING) + SPACING
    assert room.coupling.stable_dt() == pytest.approx(way / np.hypot(2.0, np.hypot(2.0, 2.0)), rel=1.0e-6)
