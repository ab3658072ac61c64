"""Fuel that burns: its budgets, the expansion of an ideal gas, and what is refused."""

import numpy as np
import pytest
from pydantic import ValidationError

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

AMBIENT, IGNITION, HEAT, RATE, SOOT = 300.0, 600.0, 1000.0, 2.0, 0.3
FIRE = {"ignition_temperature": IGNITION, "heat": HEAT, "burn_rate": RATE, "soot": SOOT}
OPEN = ("x-", "x+", "y-", "y+", "z-", "z+")
NEVER_S = 1.0e6
CELLS = 16
TORCH = {"shape": {"type": "sphere", "radius": 0.12}, "position": (0.5, 0.5, 0.2), "fuel": 0.8, "fluctuation": 0.0}


def build(*, gravity: float = 0.0, solids=(), cells: int = CELLS, **keys) -> SmokeSolver:
    """A box of a metre in which nothing happens but burning, unless keys say otherwise."""
    idle = {**TORCH, "temperature": 700.0, "start_s": NEVER_S}
    still = {"vorticity_confinement": 0.0, "cooling": 0.0, "open_faces": OPEN, "source": [idle], "fire": FIRE}
    smoke = {"name": "fire", "cell_size": 1.0 / cells, "ambient_temperature": AMBIENT, **still, **keys}
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0))
    parameters = SmokeParameters.model_validate(smoke)
    return SmokeSolver(parameters, domain=domain, gravity=(0.0, 0.0, -gravity), solids=solids)


def fill(solver: SmokeSolver, **cells: np.ndarray | float) -> None:
    """Give all cells these values, at rest."""
    state = {name: np.zeros_like(array) for name, array in solver.checkpoint().items()}
    for name, values in cells.items():
        state[name] = solver.grid.pad(np.broadcast_to(values, solver.grid.cells).astype(np.float32))
    solver.restore(state)
    solver.begin_frame(0.0)


def cells_of(solver: SmokeSolver, name: str) -> np.ndarray:
    return solver.grid.trim(solver.checkpoint()[name], solver.grid.cells).astype(np.float64)


def outflow(solver: SmokeSolver) -> float:
    """Volume that flows out through the sides in a second [m³/s]."""
    state, total = solver.checkpoint(), 0.0
    for axis, name in enumerate(("u_face_x", "v_face_y", "w_face_z")):
        faces = np.moveaxis(solver.grid.trim(state[name], solver.grid.face_shape(axis)), axis, 0).astype(np.float64)
        total += float(faces[-1].sum() - faces[0].sum())
    return total * solver.grid.cell_size**2


def test_an_even_mixture_burns_at_its_rate_and_gets_as_hot_as_its_fuel_makes_it():
    solver = build(open_faces=("z+",))
    fill(solver, fuel=0.4, excess_temperature=700.0 - AMBIENT)
    left = 0.0
    for step in range(1, 13):
        solver.substep(0.02)
        left += 0.02 * outflow(solver)
        burnt = min(0.4, RATE * 0.02 * step)
        numbers = solver.diagnostics()
        # A box of a cubic metre that is filled evenly, whatever flows out of it.
        assert numbers["burnt_fuel"] == pytest.approx(burnt, rel=1.0e-5)
        assert numbers["fuel"] == pytest.approx(0.4 - burnt, abs=1.0e-6)
        # Energy that is set free is fuel times its heat.
        assert cells_of(solver, "excess_temperature") == pytest.approx(700.0 - AMBIENT + HEAT * burnt, rel=2.0e-5)
        # An ideal gas: its volume goes with its temperature, and what has no room flows out.
        assert numbers["expanded"] == pytest.approx(np.log1p(HEAT * burnt / 700.0), rel=1.0e-4)
        assert left == pytest.approx(numbers["expanded"], rel=1.0e-4)
    # Soot is made by volume, and thinner where the gas has grown.
    assert numbers["emitted_mass"] == pytest.approx(SOOT * 0.4, rel=1.0e-5)
    assert SOOT * 0.4 * 700.0 / 1100.0 < numbers["mass"] < SOOT * 0.4


@pytest.mark.parametrize("ball", [False, True])
def test_a_burning_cloud_takes_the_room_of_an_ideal_gas(ball):
    solids = ()
    if ball:
        solids = (build_solid(Placement(shape={"type": "sphere", "radius": 0.1}, position=(0.5, 0.5, 0.5))),)
    solver = build(cells=24, solids=solids, fire={**FIRE, "burn_rate": 10.0, "ignition_temperature": 310.0})
    centres = solver.grid.cell_centres().reshape(*solver.grid.cells, 3)
    cloud = np.linalg.norm(centres - 0.5, axis=-1) < 0.25
    fill(solver, fuel=0.5 * cloud, excess_temperature=(IGNITION - AMBIENT + 100.0) * cloud)
    volume = solver.obstacles.open_volume().astype(np.float64) * solver.grid.cell_size**3
    before, out = float(volume[cloud].sum()), 0.0
    for _ in range(12):
        solver.substep(0.005)
        out += 0.005 * outflow(solver)
    numbers = solver.diagnostics()
    assert numbers["expanded"] == pytest.approx(out, rel=1.0e-3)
    # 1200 K where there were 700: so much more room does an ideal gas take. Cells at its edge mix fuel and air by
    # volume, not by mass, before they burn, which makes it 6 % more for a ball of six cells.
    assert out == pytest.approx(before * (1200.0 / 700.0 - 1.0), rel=0.08)
    assert numbers["max_temperature"] == pytest.approx(1200.0, rel=1.0e-4)
    assert numbers["mass"] == pytest.approx(SOOT * numbers["burnt_fuel"], rel=1.0e-5)


def test_nothing_burns_that_is_too_cold_and_fuel_goes_with_the_gas():
    solver = build(open_faces=(), fire={**FIRE, "expansion": 0.0})
    fill(solver, fuel=0.4, excess_temperature=IGNITION - AMBIENT - 1.0)
    for _ in range(5):
        solver.substep(0.02)
    numbers = solver.diagnostics()
    assert numbers["burnt_fuel"] == 0.0
    assert numbers["fuel"] == pytest.approx(0.4, rel=1.0e-6)


def test_a_torch_burns_what_it_is_given_and_stays_symmetric():
    torch = {**TORCH, "temperature": 700.0, "density": 0.0, "end_s": 0.1}
    solver = build(gravity=9.81, source=[torch], open_faces=("x-", "x+", "y-", "y+", "z+"))
    solver.begin_frame(0.0)
    hottest = 0.0
    for _ in range(36):
        solver.substep(1.0 / 60.0)
        hottest = max(hottest, solver.diagnostics()["max_temperature"])
    # 0.8 of the heat on top of the source's 700 K, less what it mixes with.
    assert 1100.0 < hottest < 1500.0
    # Half a second after the last was given, what is left is what has mixed with cold air before.
    assert cells_of(solver, "fuel")[cells_of(solver, "excess_temperature") > IGNITION - AMBIENT].max() < 1.0e-3
    assert solver.diagnostics()["burnt_fuel"] > 4.0 * solver.diagnostics()["fuel"]
    for name in ("density", "excess_temperature", "fuel"):
        values = cells_of(solver, name)
        for mirrored in (values[::-1], values[:, ::-1], values.transpose(1, 0, 2)):
            assert mirrored == pytest.approx(values, abs=2.0e-3 * max(1.0e-3, np.abs(values).max()))


def test_ten_steps_equal_five_and_a_restore_and_five():
    torch = {**TORCH, "temperature": 700.0, "flicker": 0.4, "fluctuation": 0.3}
    solver = build(gravity=9.81, source=[torch], open_faces=("z+",), radiative_cooling=2000.0)
    start = solver.checkpoint()
    for _ in range(5):
        solver.substep(1.0 / 60.0)
    middle = solver.checkpoint()
    for _ in range(5):
        solver.substep(1.0 / 60.0)
    uninterrupted = solver.checkpoint()
    assert uninterrupted["burnt"][0] > middle["burnt"][0] > 0.0
    solver.restore(start)
    solver.restore(middle)
    for _ in range(5):
        solver.substep(1.0 / 60.0)
    for name, values in solver.checkpoint().items():
        assert np.array_equal(values, uninterrupted[name]), name


def test_a_window_takes_its_fuel_along():
    torch = {**TORCH, "temperature": 700.0}
    found = []
    for grid in ("box", "window"):
        solver = build(gravity=9.81, source=[torch], open_faces=OPEN, grid=grid)
        for frame in range(6):
            solver.begin_frame(frame / 24.0)
            for _ in range(2):
                solver.substep(1.0 / 48.0)
        found.append(solver.diagnostics())
    assert found[1]["burnt_fuel"] == pytest.approx(found[0]["burnt_fuel"], rel=0.02)
    assert found[1]["fuel"] == pytest.approx(found[0]["fuel"], rel=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fire": None}, "has no meaning without a fire"),
        ({"source": [{**TORCH, "fuel": 0.0, "temperature": 700.0}]}, "has nothing to burn; give a source fuel"),
        ({"fire": {**FIRE, "ignition_temperature": 290.0}}, "290 K is no more than the air's 300 K"),
        ({"fire": {**FIRE, "ignition_temperature": 900.0}}, "900 K is more than any source has: nothing takes fire"),
        ({"open_faces": ()}, "has no room in a box without open faces"),
        ({"fire": {**FIRE, "burn_rate": 0.0}}, "greater than 0"),
        ({"fire": {**FIRE, "expansion": 1.5}}, "less than or equal to 1"),
        ({"source": [{**TORCH, "fuel": 1.2}]}, "less than or equal to 1"),
    ],
)
def test_a_fire_that_cannot_burn_is_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        build(**changes)
