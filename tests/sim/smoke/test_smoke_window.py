"""A smoke's grid that follows what is there, beside the whole box."""

import numpy as np
import pytest
from pydantic import ValidationError

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.core.solver import OutgrownError
from sim.core.world import World
from sim.scene import SceneParameters
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FPS = 24.0
CELL = 1.0 / 24.0
LONG = DomainParameters(min=(-0.5, -0.5, 0.0), max=(2.5, 0.5, 1.0))
SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")
PUFF = {"shape": {"type": "sphere", "radius": 0.12}, "position": (-0.1, 0.0, 0.4), "temperature": 310.0, "end_s": 0.2}
GUSTY = {"type": "wind", "velocity": (2.0, 0.0, 0.0), "gusts": 0.5, "gust_s": 0.3}
BALL = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "position": (0.3, 0.0, 0.45)}


def puff(grid: str, domain: DomainParameters = LONG, **changes) -> SmokeSolver:
    keys = {"name": "puff", "cell_size": CELL, "grid": grid, "wind": (1.0, 0.0, 0.0), "open_faces": SIDES}
    parameters = SmokeParameters.model_validate({**keys, "source": [PUFF], **changes})
    return SmokeSolver(parameters, domain=domain, gravity=(0.0, 0.0, -9.81), frame_s=1.0 / FPS)


def advance(solver: SmokeSolver, frames: int) -> list[int]:
    """How many cells there were in each frame."""
    world, counts = World([solver], frames_per_second=FPS), []
    for _ in range(frames):
        world.advance_frame()
        counts.append(int(np.prod(solver.grid.cells)))
    return counts


def in_box(solver: SmokeSolver, cells: tuple[int, int, int]) -> np.ndarray:
    """The density in the cells of the whole box."""
    density = np.zeros(cells)
    first, last = np.array(solver.grid.first), np.add(solver.grid.first, solver.grid.cells)
    low, high = np.maximum(first, 0), np.minimum(last, cells)
    own = tuple(map(slice, low - first, high - first))
    density[tuple(map(slice, low, high))] = solver.snapshots()["puff"].arrays["density"][own]
    return density


def middle(solver: SmokeSolver) -> np.ndarray:
    """Where the smoke is on average [m], by the origin that a frame tells."""
    snapshot = solver.snapshots()["puff"]
    density = snapshot.arrays["density"].astype(np.float64)
    places = np.indices(density.shape) + 0.5
    mean = (places * density).sum(axis=(1, 2, 3)) / density.sum()
    return np.array(snapshot.vector("origin")) + snapshot.number("cell_size") * mean


def equal(first: dict, second: dict) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("grid", ["window", "open"])
def test_a_puff_that_drifts_far_is_that_of_the_whole_box(grid):
    whole, own = puff("box"), puff(grid)
    all_cells, cells = advance(whole, 36), advance(own, 36)
    expected = whole.snapshots()["puff"].arrays["density"].astype(np.float64)
    assert np.abs(in_box(own, whole.grid.cells) - expected).sum() < 0.015 * expected.sum()
    assert np.abs(middle(own) - middle(whole)).max() < 0.05 * CELL
    assert middle(own)[0] > 1.3
    numbers = own.diagnostics()
    assert numbers["mass"] == pytest.approx(numbers["emitted_mass"], rel=1e-4)
    assert numbers["cells"] == cells[-1]
    assert sum(cells) < 0.5 * sum(all_cells)
    assert own.grid.first[0] >= 16


def test_an_open_grid_goes_on_beyond_the_box_and_keeps_its_smoke():
    solver = puff("open", wind=(4.0, 0.0, 0.0))
    advance(solver, 30)
    assert middle(solver)[0] == pytest.approx(-0.1 + 4.0 * 30 / FPS, abs=0.5)
    assert solver.grid.origin[0] > LONG.max[0]
    numbers = solver.diagnostics()
    assert numbers["mass"] == pytest.approx(numbers["emitted_mass"], rel=1e-3)


def test_closed_sides_end_an_open_grid():
    """On the floor, and without end elsewhere: all of it is above."""
    solver = puff("open", wind=(0.0, 0.0, 0.0), open_faces=("x-", "x+", "y-", "y+", "z+"), buoyancy_temperature=0.3)
    advance(solver, 48)
    assert solver.grid.first[2] == 0
    assert solver.grid.upper[2] > LONG.max[2]
    assert not solver.grid.is_open(2, 0)
    assert solver.grid.is_open(2, 1)


def test_a_window_that_has_all_cells_has_the_bits_of_the_box():
    domain = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
    source = {**PUFF, "shape": {"type": "sphere", "radius": 0.3}, "position": (0.0, 0.0, 0.5), "temperature": 400.0}
    solvers = [
        puff(grid, domain, cell_size=1.0 / 16.0, source=[source], turbulence={"strength": 2.0}, open_faces=faces)
        for faces in (SIDES, SIDES[:2])
        for grid in ("box", "window")
    ]
    for solver in solvers:
        advance(solver, 8)
        assert solver.grid.cells == (16, 16, 16)
    for whole, own in (solvers[:2], solvers[2:]):
        state = own.checkpoint()
        assert state.pop("window").tolist() == [[0, 0, 0], [16, 16, 16]]
        assert equal(state, whole.checkpoint())


def test_a_window_gets_small_again():
    """When the wind has blown all out of the box."""
    solver = puff("window", wind=(2.5, 0.0, 0.0))
    cells = advance(solver, 48)
    assert solver.diagnostics()["mass"] < 1e-3 * solver.diagnostics()["emitted_mass"]
    assert cells[-1] <= 16 * 16 * 16
    assert max(cells) > 3 * cells[-1]


@pytest.mark.parametrize("stirs", ["gusts", "force"])
def test_what_stirs_all_air_alike_does_not_make_a_window_grow(stirs):
    """After the source has ended nothing but eddies moves: they are in all cells, fresh ones too."""
    cold = {**PUFF, "temperature": 293.0, "end_s": 0.1}
    smoke = {"name": "puff", "cell_size": CELL, "grid": "open", "source": [cold], "open_faces": SIDES}
    if stirs == "gusts":
        scene = {"smoke": [{**smoke, "turbulence": {"strength": 0.4, "size": 0.3}}]}
    else:
        eddies = {"type": "turbulence", "speed": 0.5, "size": 1.0}
        scene = {"smoke": [smoke], "force": [eddies, {**GUSTY, "velocity": (0.3, 0.0, 0.0), "gusts": 0.9}]}
    world = build_world(SceneParameters.model_validate({**scene, "domain": LONG}), frames_per_second=FPS)
    for _ in range(24):
        world.advance_frame()
    assert np.prod(world.solvers["puff"].grid.cells) < 40_000


def test_a_window_follows_fuel_that_has_not_burnt():
    cold = {**PUFF, "temperature": 293.0, "density": 0.0, "fuel": 0.5}
    match = {**PUFF, "temperature": 900.0, "start_s": 90.0, "end_s": 91.0}
    solver = puff("open", source=[cold, match], fire={}, buoyancy_density=0.0)
    advance(solver, 24)
    numbers = solver.diagnostics()
    assert numbers["burnt_fuel"] == 0.0
    assert solver.grid.first[0] > 12
    assert numbers["fuel"] > 0.0


def test_fresh_air_moves_with_the_wind():
    """Which nothing disturbs, wherever the window is."""
    idle = {**PUFF, "temperature": 293.0, "fluctuation": 0.0}
    solver = puff("open", wind=(3.0, -1.0, 0.0), source=[idle], buoyancy_density=0.0, vorticity_confinement=0.0)
    first = solver.grid.first
    advance(solver, 24)
    assert solver.grid.first[0] > first[0] + 16
    velocity = solver.snapshots()["puff"].arrays["velocity"]
    assert np.abs(velocity - np.array([3.0, -1.0, 0.0])).max() < 3e-4


def gusty_world(grid: str) -> World:
    """A source on its way through gusts, past a ball that stands and one that moves."""
    way = [{"time_s": 0.0, "position": (-0.3, 0.0, 0.5)}, {"time_s": 0.8, "position": (1.2, 0.1, 0.5)}]
    source = {"shape": {"type": "sphere", "radius": 0.08}, "keyframe": way, "temperature": 330.0}
    smoke = {"name": "puff", "cell_size": CELL, "grid": grid, "source": [source]}
    moving = {**BALL, "name": "mover", "kind": "kinematic", "position": (0.6, 0.3, 0.4), "velocity": (0.0, -0.5, 0.0)}
    scene = {"domain": LONG, "smoke": [smoke], "rigid": [BALL, moving], "force": [GUSTY]}
    return build_world(SceneParameters.model_validate(scene), frames_per_second=FPS)


def test_a_run_that_continues_has_the_bits_of_one_that_did_not_stop():
    world, again = gusty_world("open"), gusty_world("open")
    windows = []
    for _ in range(18):
        world.advance_frame()
        windows.append(world.solvers["puff"].grid.window)
        if world.frame == 9:
            state = world.checkpoint()
    assert windows[8] != windows[17]
    again.restore(9, state)
    assert again.solvers["puff"].grid.window == windows[8]
    while again.frame < 18:
        again.advance_frame()
    assert equal(again.checkpoint(), world.checkpoint())


def test_bodies_are_in_a_window_that_comes_to_them():
    """And are what they are in the whole box."""
    own, whole = gusty_world("window"), gusty_world("box")
    for world in (own, whole):
        for _ in range(18):
            world.advance_frame()
    smoke, box = own.solvers["puff"], whole.solvers["puff"]
    low, high = np.array(smoke.grid.first), np.add(smoke.grid.first, smoke.grid.cells)
    part = box.obstacles.open_volume()[tuple(map(slice, low, high))]
    assert (part < 1.0).sum() > 100
    assert np.abs(smoke.obstacles.open_volume() - part).max() < 1e-3
    expected = box.snapshots()["puff"].arrays["density"].astype(np.float64)
    assert np.abs(in_box(smoke, box.grid.cells) - expected).sum() < 0.05 * expected.sum()


def test_a_restore_refuses_a_checkpoint_without_a_window():
    solver = puff("window")
    state = solver.checkpoint()
    del state["window"]
    with pytest.raises(ValueError, match="window must be two cells, got None"):
        solver.restore(state)


def test_no_memory_for_a_larger_window_is_told_with_its_number_and_costs_nothing():
    solver, asked = puff("open", wind=(0.0, 0.0, 0.0), buoyancy_temperature=0.3), []

    def refuse(more: float) -> str:
        asked.append(more)
        return "there is none"

    world, again = World([solver], frames_per_second=FPS), puff("open", wind=(0.0, 0.0, 0.0), buoyancy_temperature=0.3)
    cells = solver.grid.cells
    solver.refusal = refuse
    with pytest.raises(OutgrownError, match=r'smoke "puff" grows at [0-9.]+ s from [0-9,]+ to [0-9,]+ cells: there is'):
        for _ in range(60):
            world.advance_frame()
    assert asked
    assert asked[0] > 0.0
    assert solver.grid.cells == cells
    state, frame = world.checkpoint(), world.frame
    solver.refusal = None
    world.advance_frame()
    other = World([again], frames_per_second=FPS)
    other.restore(frame, state)
    other.advance_frame()
    assert equal(other.checkpoint(), world.checkpoint())


def test_wind_of_a_force_blows_through_open_sides_as_it_does_outside():
    """Air that such a wind takes along outside is not held up where it comes in."""
    smoke = {
        "name": "puff",
        "cell_size": 1.0 / 12.0,
        "open_faces": SIDES,
        "source": [{**PUFF, "start_s": 9.0, "end_s": 10.0}],
    }
    scene = {"domain": LONG, "smoke": [smoke], "force": [{"type": "wind", "velocity": (3.0, 1.0, 0.0)}]}
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=FPS)
    for _ in range(60):
        world.advance_frame()
    velocity = world.snapshots()["puff"].arrays["velocity"]
    expected = (1.0 - np.exp(-2.5 / 0.5)) * np.array([3.0, 1.0, 0.0])
    assert np.abs(velocity - expected).max() < 0.01


def test_an_open_grid_needs_an_open_side_and_windows_stand_alone():
    with pytest.raises(ValidationError, match='"open" has no meaning where all sides are walls'):
        puff("open", open_faces=())
    smoke = {"name": "puff", "grid": "window", "source": [PUFF]}
    flag = {"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (5, 5)}}
    with pytest.raises(ValidationError, match='"window" is of a smoke in a job with cloth'):
        SceneParameters.model_validate({"smoke": [smoke], "cloth": [flag]})
