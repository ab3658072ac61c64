import math

import numpy as np
import pytest
from smoke_scenes import OPEN_BOX, Bytes
from thread_counts import digest_of, result_on_any_threads

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke import multigrid
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

GRAVITY = (0.0, 0.0, -9.81)
DOMAIN = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.5))
BALL = {"shape": {"type": "sphere", "radius": 0.15}}
SOURCE = {"shape": {"type": "sphere", "radius": 0.12}, "position": (0.02, 0.0, 0.2), "temperature": 450.0}


def plume(**changes) -> SmokeParameters:
    return SmokeParameters(**{"name": "plume", "cell_size": 1 / 16, "source": [SOURCE], **changes})


def build_plume(**changes) -> SmokeSolver:
    obstacle = build_solid(Placement(**BALL, position=(0.0, 0.0, 0.7)))
    return SmokeSolver(plume(**changes), domain=DOMAIN, gravity=GRAVITY, solids=[obstacle])


def advance(solver: SmokeSolver, substeps: int) -> None:
    for _ in range(substeps):
        solver.substep(min(solver.stable_dt(), 1 / 60))


@pytest.fixture(scope="module")
def shared_plume(taichi_cpu):
    return build_plume()


@pytest.fixture
def solver(shared_plume):
    """At rest and empty, as just built, without compiling it anew."""
    shared_plume.restore({name: np.zeros_like(array) for name, array in shared_plume.checkpoint().items()})
    shared_plume.begin_frame(0.0)
    return shared_plume


def test_a_hot_plume_rises_past_a_ball_and_counts_what_it_emits(solver):
    advance(solver, 1)
    first = solver.diagnostics()
    # Nothing moves yet, so all that is there was emitted; both are sums of the same single-precision numbers.
    assert first["mass"] == pytest.approx(first["emitted_mass"], rel=1.0e-6)
    ball_of_smoke = 4.0 / 3.0 * np.pi * 0.12**3
    assert first["mass"] == pytest.approx(ball_of_smoke, rel=0.01)

    solver.begin_frame(solver.checkpoint()["clock"][0])
    heights = []
    for _ in range(4):
        advance(solver, 15)
        density = solver.snapshots()["plume"].arrays["density"]
        z = (np.arange(density.shape[2]) + 0.5) * solver.grid.cell_size
        heights.append(float((density.sum(axis=(0, 1)) * z).sum() / density.sum()))
    assert heights == sorted(heights)
    assert heights[-1] > heights[0] + 0.1
    last = solver.diagnostics()
    assert last["emitted_mass"] > first["emitted_mass"]
    assert last["not_converged"] == 0.0
    assert 0.0 < last["residual"] <= solver.parameters.projection_tolerance
    assert last["iterations"] > 0.0
    assert 0.1 < last["max_speed"] < 5.0
    assert last["max_temperature"] <= 450.0 + 1.0e-3
    assert solver.first_bad_quantity() is None


def test_heat_of_the_source_fluctuates_within_its_bounds_and_the_same_in_every_run(solver):
    fields = []
    for time_s in (0.0, 0.06, 0.0):
        solver.restore({name: np.zeros_like(array) for name, array in solver.checkpoint().items()})
        solver.begin_frame(time_s)
        solver._emit(1 / 60)
        snapshot = solver.snapshots()["plume"].arrays
        fields.append(snapshot["temperature"][snapshot["density"] == 1.0])  # cells that it covers whole
    first, later, again = fields
    assert np.array_equal(first, again)
    assert not np.array_equal(first, later)
    (source,) = solver.parameters.source
    shortfall = (450.0 - first) / (450.0 - 293.0)
    # The bounds, but for the rounding of temperatures in single precision: 3e-5 K of 157 K.
    assert -1.0e-6 < shortfall.min() < shortfall.max() < source.fluctuation + 1.0e-6
    assert np.ptp(shortfall) > 0.1 * source.fluctuation


def test_ten_steps_equal_five_and_a_restore_and_five(solver):
    advance(solver, 10)
    uninterrupted = solver.checkpoint()
    solver.restore({name: np.zeros_like(array) for name, array in uninterrupted.items()})
    advance(solver, 5)
    half = solver.checkpoint()
    advance(solver, 3)
    solver.restore(half)
    advance(solver, 5)
    for name, array in solver.checkpoint().items():
        assert np.array_equal(array, uninterrupted[name]), name


def test_air_goes_around_solids_and_no_smoke_is_in_them(solver):
    advance(solver, 40)
    snapshot = solver.snapshots()["plume"]
    solid = solver.grid.solid
    assert (1.0 - solver.obstacles.open_volume()).sum() > 20
    assert not snapshot.arrays["density"][solid].any()
    assert (snapshot.arrays["temperature"][solid] == np.float32(293.0)).all()
    assert not snapshot.arrays["velocity"][solid].any()
    # Nothing crosses its surface: what flows through the open faces of a cell that it cuts is all.
    flux = 0.0
    for axis, (name, area) in enumerate(
        zip(("u_face_x", "v_face_y", "w_face_z"), solver.obstacles.solids.area, strict=True)
    ):
        shape = solver.grid.face_shape(axis)
        through = (solver.grid.trim(values, shape) for values in (area.to_numpy(), solver.checkpoint()[name]))
        flux = flux + np.diff(np.prod([each.astype(np.float64) for each in through], axis=0), axis=axis)
    cut = (solver.obstacles.open_volume() < 1.0) & ~solid
    assert cut.sum() > 20
    assert np.abs(flux[cut]).max() < 1.1e-5 * solver.diagnostics()["max_speed"]
    # Beside the ball the plume passes; its cells there do move.
    assert np.abs(snapshot.arrays["velocity"][..., 2])[~solid].max() > 0.1


def test_snapshot_is_cell_centred_and_says_where_it_lies(solver):
    advance(solver, 3)
    snapshot = solver.snapshots()["plume"]
    assert snapshot.kind == "smoke"
    shapes = {name: (array.shape, array.dtype) for name, array in snapshot.arrays.items()}
    assert shapes == {
        "density": ((16, 16, 24), np.float32),
        "temperature": ((16, 16, 24), np.float32),
        "velocity": ((16, 16, 24, 3), np.float32),
    }
    assert snapshot.attributes == {"origin": (-0.5, -0.5, 0.0), "cell_size": 1 / 16, "ambient_temperature": 293.0}
    u = solver.grid.trim(solver.checkpoint()["u_face_x"], solver.grid.face_shape(0))
    expected = np.where(solver.grid.solid, np.float32(0.0), 0.5 * (u[1:] + u[:-1]))
    assert np.array_equal(snapshot.arrays["velocity"][..., 0], expected)


def test_a_source_emits_in_every_step_that_it_has_a_part_of():
    (source,) = plume(source=[{**SOURCE, "start_s": 1.0, "end_s": 2.0}]).source
    steps = [(0.0, 1.0), (0.9, 1.1), (1.4, 1.5), (0.0, 3.0), (1.9, 2.1), (2.0, 2.1)]
    assert [source.emits_during(*step) for step in steps] == [False, True, True, True, True, False]
    (endless,) = plume().source
    assert endless.emits_during(1.0e6, 1.0e6 + 1.0e-3)


@pytest.mark.slow
def test_a_source_shorter_than_a_step_is_not_missed():
    short = plume(source=[{**SOURCE, "start_s": 0.002, "end_s": 0.012}])
    solver = SmokeSolver(short, domain=DOMAIN, gravity=GRAVITY)
    solver.begin_frame(0.0)
    solver.substep(min(solver.stable_dt(), 1 / 60))
    assert solver.diagnostics()["emitted_mass"] > 0.0


@pytest.mark.slow
def test_a_cold_source_sinks():
    cold = plume(source=[{**SOURCE, "temperature": 250.0, "position": (0.0, 0.0, 1.0), "density": 0.0}])
    solver = SmokeSolver(cold, domain=DOMAIN, gravity=GRAVITY)
    solver.begin_frame(0.0)
    advance(solver, 6)
    snapshot = solver.snapshots()["plume"]
    assert snapshot.arrays["temperature"].min() < 293.0
    # Air 43 K colder falls with 9.81 * 43 / 293 = 1.4 m/s²; after a tenth of a second it moves downward at least.
    assert snapshot.arrays["velocity"][8, 8, 16, 2] < -0.01


def test_an_obstacle_that_falls_between_the_cells_is_refused():
    plate = build_solid(Placement(shape={"type": "box", "size": (0.4, 0.4, 0.01)}, position=(0.0, 0.0, 0.65625)))
    with pytest.raises(ValueError, match=r"0\.01 m thin falls between its cells of 0\.0625 m"):
        SmokeGrid.build(plume(), DOMAIN, [plate])


def test_a_field_that_is_not_finite_is_named(solver):
    state = solver.checkpoint()
    assert solver.first_bad_quantity() is None
    state["density"][3, 4, 5] = np.nan
    state["w_face_z"][3, 4, 5] = np.inf
    solver.restore(state)
    assert solver.first_bad_quantity() == "w_face_z is not finite at 1 places"


def test_a_checkpoint_of_another_grid_is_refused(solver):
    state = solver.checkpoint()
    with pytest.raises(ValueError, match=r"density must have shape \(18, 18, 26\), got shape \(2, 2, 2\)"):
        solver.restore({**state, "density": np.zeros((2, 2, 2), np.float32)})
    del state["clock"]
    with pytest.raises(ValueError, match=r"clock must have shape \(2,\), got nothing"):
        solver.restore(state)


def test_first_step_from_rest_is_bounded_by_the_lift_of_the_source(solver):
    dt = solver.stable_dt()
    parameters = solver.parameters
    acceleration = 9.81 / 293.0 * (450.0 - 293.0) + parameters.buoyancy_density
    # The lift of the source is all that moves: a dt^2 = cfl h.
    assert acceleration * dt**2 == pytest.approx(parameters.cfl * parameters.cell_size, rel=1.0e-6)


@pytest.mark.parametrize(
    ("gravity", "changes", "expected"),
    [
        (GRAVITY, {}, 9.81 / 293.0),
        ((0.0, 0.0, -1.62), {"ambient_temperature": 220.0}, 1.62 / 220.0),
        ((3.0, 0.0, -4.0), {}, 5.0 / 293.0),
        ((0.0, 0.0, 0.0), {}, 0.0),
        ((0.0, 0.0, -1.62), {"buoyancy_temperature": 0.02}, 0.02),
    ],
)
def test_heat_lifts_as_an_ideal_gas_does_unless_it_is_said(gravity, changes, expected):
    # Equal to the bit: what a scene of the earth gives does not change.
    assert plume(**changes).lift_per_kelvin(gravity) == expected


def test_a_plume_on_the_moon_is_slower():
    """From rest and without drag speeds grow with gravity: a sixth of it, a sixth of the speed of the first moment."""
    speeds = []
    for gravity in (GRAVITY, (0.0, 0.0, -1.62)):
        solver = SmokeSolver(plume(buoyancy_density=0.0), domain=DOMAIN, gravity=gravity)
        for _ in range(2):
            solver.substep(0.01)
        speeds.append(solver.diagnostics()["max_speed"])
    # Advection and confinement, which are of second order, are all that is not proportional.
    assert speeds[1] / speeds[0] == pytest.approx(1.62 / 9.81, rel=0.05)


def test_a_source_without_a_cell_is_refused_with_a_remedy():
    outside = plume(source=[{**SOURCE, "position": (3.0, 0.0, 0.0)}])
    with pytest.raises(ValueError, match=r'smoke "plume", source 0: it covers no cell; move it'):
        SmokeSolver(outside, domain=DOMAIN, gravity=GRAVITY)


def test_a_box_full_of_solid_is_refused():
    rock = build_solid(Placement(shape={"type": "box", "size": (5.0, 5.0, 5.0)}))
    with pytest.raises(ValueError, match="solids fill its whole box"):
        SmokeGrid.build(plume(), DOMAIN, [rock])


def test_grid_is_the_domain_unless_the_smoke_names_its_own_box():
    assert SmokeGrid.build(plume(), DOMAIN).cells == (16, 16, 24)
    assert SmokeGrid.build(plume(cell_size=0.02), DOMAIN).cells == (50, 50, 75)
    own = SmokeGrid.build(plume(min=(0.0, 0.0, 0.0), max=(0.3, 0.2, 0.1), cell_size=0.04), DOMAIN)
    assert own.cells == (8, 5, 3)
    assert own.origin == (0.0, 0.0, 0.0)
    assert own.is_open(2, 1)
    assert not own.is_open(2, 0)
    assert own.open_faces == frozenset(OPEN_BOX)
    with pytest.raises(ValueError, match="got z from 0 to -1 m"):
        SmokeGrid.build(plume(max=(0.5, 0.5, -1.0)), DOMAIN)


def test_a_plain_box_takes_less_than_120_bytes_a_cell(monkeypatch):
    made = Bytes(monkeypatch)
    solver = SmokeSolver(plume(cell_size=1 / 64), domain=DOMAIN, gravity=GRAVITY)  # a GPU sums over 131,072 lanes
    cells = math.prod(solver.grid.cells)
    assert made.total < 120 * cells


def digests_of_plumes() -> list[str]:
    """Of a plume in gusts as a small grid, and as a large one, whose coarse levels one thread computes."""
    found = []
    for few_cells in (multigrid.FEW_CELLS, 500):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(multigrid, "FEW_CELLS", few_cells)
            solver = build_plume(wind=(0.5, 0.2, 0.0), turbulence={"strength": 2.0, "size": 0.2, "rate": 4.0})
            advance(solver, 6)
        found.append(digest_of(solver.checkpoint()))
    return found


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_a_bit():
    assert len(result_on_any_threads(digests_of_plumes)) == 2
