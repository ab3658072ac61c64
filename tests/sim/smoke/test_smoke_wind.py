"""Wind through the box: what flows in, flows out, and smoke goes with it."""

import numpy as np
import pytest

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.5, 0.75, 0.75))
CELL = 1 / 16
FACES = ("u_face_x", "v_face_y", "w_face_z")
COLD = {
    "shape": {"type": "sphere", "radius": 0.1},
    "position": (0.3, 0.4, 0.4),
    "temperature": 293.0,
}


def build(*, obstacles=(), gravity=(0.0, 0.0, 0.0), **changes) -> SmokeSolver:
    parameters = SmokeParameters(**{"name": "plume", "cell_size": CELL, "source": [COLD], **changes})
    return SmokeSolver(parameters, domain=DOMAIN, gravity=gravity, solids=obstacles)


def advance(solver: SmokeSolver, duration_s: float) -> None:
    solver.begin_frame(0.0)
    remaining = duration_s
    while remaining > 0.0:
        count = int(np.ceil(remaining / min(solver.stable_dt(), 1 / 60)))
        solver.substep(remaining / count)
        remaining = remaining - remaining / count if count > 1 else 0.0


def faces(solver: SmokeSolver) -> list[np.ndarray]:
    state = solver.checkpoint()
    return [solver.grid.trim(state[name], solver.grid.face_shape(axis)) for axis, name in enumerate(FACES)]


def fluxes(solver: SmokeSolver) -> tuple[float, float]:
    """What flows in and out through the sides of the box, where there is air behind them [m³/s]."""
    through, is_air = [], solver.obstacles.is_air()
    for axis, face in enumerate(faces(solver)):
        ends = np.moveaxis(face, axis, 0)[[0, -1]].astype(np.float64) * CELL**2
        ends *= np.moveaxis(is_air, axis, 0)[[0, -1]]
        through += [*ends[0].ravel(), *-ends[1].ravel()]
    values = np.array(through)
    return float(values[values > 0.0].sum()), float(-values[values < 0.0].sum())


def test_uniform_wind_through_an_open_box_stays_uniform():
    wind = (1.0, -2.0, 0.5)
    solver = build(wind=wind, open_faces=("x-", "x+", "y-", "y+", "z-", "z+"))
    advance(solver, 1.0)
    for axis, face in enumerate(faces(solver)):
        # Look-ups mix equal numbers with weights that sum up to 1 but for rounding, 6e-8 a step of some forty.
        assert np.abs(face - wind[axis]).max() < 1.0e-6 * max(map(abs, wind)), f"{axis}"
    assert solver.diagnostics()["not_converged"] == 0.0


def test_smoke_goes_with_the_wind_at_its_speed_and_clean_air_follows():
    speed = 2.0
    solver = build(
        wind=(speed, 0.0, 0.0),
        source=[{**COLD, "end_s": 0.01}],
        vorticity_confinement=0.0,
        advection="semi_lagrangian",
    )
    advance(solver, 0.01)
    x = (np.arange(solver.grid.cells[0]) + 0.5) * CELL

    def centre() -> float:
        density = solver.snapshots()["plume"].arrays["density"].sum(axis=(1, 2))
        return float((density * x).sum() / density.sum())

    start = centre()
    for _ in range(10):
        solver.substep(0.02)
    # Linear look-ups keep the first moment of a puff: in a uniform flow its centre moves exactly as far as the air.
    assert centre() - start == pytest.approx(speed * 0.2, abs=1.0e-4)
    for _ in range(40):
        solver.substep(0.02)
    # It crossed the box, of 1.5 m, 0.5 m ago; what comes in is clean.
    assert solver.snapshots()["plume"].arrays["density"].max() < 1.0e-3


@pytest.fixture(scope="module")
def gusty_ball(taichi_cpu):
    """Wind with gusts on a ball."""
    ball = build_solid(Placement(shape={"type": "sphere", "radius": 0.17}, position=(0.7, 0.375, 0.375)))
    gusts = {"strength": 2.0, "size": 0.25, "rate": 7.0, "seed": 5}
    return build(obstacles=[ball], wind=(2.0, 0.3, 0.0), turbulence=gusts, vorticity_confinement=0.0)


def test_wind_flows_around_a_ball_and_as_much_out_as_in(gusty_ball):
    solver, speed = gusty_ball, 2.0
    advance(solver, 0.5)
    flow_in, flow_out = fluxes(solver)
    u, v = faces(solver)[:2]
    assert np.array_equal(u[0], np.full_like(u[0], speed))
    assert np.array_equal(v[:, 0], np.full_like(v[:, 0], 0.3))
    assert flow_in >= (speed * 0.75**2 + 0.3 * 0.75 * 1.5) * (1.0 - 1e-6)
    # Divergence of each cell is below 1e-5 of max|u|/h; over the box that adds up to less than 1e-3.
    assert flow_in == pytest.approx(flow_out, rel=1.0e-3)
    # On the closed faces inside the ball only the flow along its surface is continued.
    assert solver.grid.solid.any()
    # Beside the ball the air is faster: half as fast again as the wind by potential flow, and gusts.
    beside = u[11, :, 5]
    assert 1.1 * speed < beside.max() < 1.7 * speed
    assert solver.diagnostics()["residual"] <= solver.parameters.projection_tolerance


def test_wind_and_gusts_go_on_after_a_restart_as_if_uninterrupted(gusty_ball):
    solver = gusty_ball
    solver.begin_frame(0.0)
    start = solver.checkpoint()
    for _ in range(6):
        solver.substep(0.02)
    whole = solver.checkpoint()
    solver.restore(start)
    for _ in range(3):
        solver.substep(0.02)
    half = solver.checkpoint()
    solver.restore(start)
    solver.restore(half)
    for _ in range(3):
        solver.substep(0.02)
    for name, array in solver.checkpoint().items():
        assert np.array_equal(array, whole[name]), name
    assert not np.array_equal(half["u_face_x"], whole["u_face_x"])


def test_a_hot_plume_leans_with_a_cross_wind():
    wind = 0.5
    hot = {**COLD, "position": (0.25, 0.375, 0.1), "temperature": 500.0, "fluctuation": 0.0}
    solver = build(source=[hot], wind=(wind, 0.0, 0.0), gravity=(0.0, 0.0, -9.81))
    advance(solver, 1.0)
    arrays = solver.snapshots()["plume"].arrays
    density, velocity = arrays["density"].astype(np.float64), arrays["velocity"].astype(np.float64)
    x, y, _ = (0.5 + np.indices(density.shape)) * CELL

    # Some way above the source, layer by layer, by the smoke that rises through it.
    layers = slice(4, 10)
    flux = (density * velocity[..., 2]).sum(axis=(0, 1))[layers]
    line, across = ((density * velocity[..., 2] * place).sum(axis=(0, 1))[layers] / flux for place in (x, y))
    drift = (density * velocity[..., 0]).sum(axis=(0, 1))[layers]
    # In air at rest it would stand upright; what it draws in brings the wind's velocity with it, and pressure on its
    # windward side a little more.
    assert line[-1] - 0.25 > 0.2
    speed = drift / density.sum(axis=(0, 1))[layers]
    assert 0.9 * wind < speed.min() < speed.max() < 1.3 * wind
    # Where a plume is steady the line through it has the slope of the fluxes, d/dz int(w rho x) = int(u rho), as
    # div(rho u) = 0 times x, integrated over a layer; at 1 s its height of 0.3 m was passed four times.
    slope = drift / flux
    way = CELL * 0.5 * (slope[1:] + slope[:-1]).sum()
    assert line[-1] - line[0] == pytest.approx(way, rel=0.15)
    assert across == pytest.approx(0.375, abs=1.0e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"open_faces": ("x+", "z+")}, 'wind blows in through the side "x-", which is closed; add it to open_faces'),
        ({"open_faces": ("x-",)}, "as much must flow out, for air of constant density cannot be compressed"),
    ],
)
def test_wind_that_air_cannot_follow_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        build(wind=(1.0, 0.0, 0.0), **changes)


def plate(x: float, **changes) -> object:
    """A plate across the whole box but for what `changes` leave open."""
    shape = {"type": "box", "size": (2.0 * CELL, 2.0, 2.0), **changes}
    return build_solid(Placement(shape=shape, position=(x, 0.375, 0.375)))


@pytest.mark.parametrize(
    ("obstacle", "changes"),
    [
        (plate(0.75), {}),
        (plate(0.75), {"wind": (-1.0, 0.0, 0.0)}),
        # The same air, but the wind comes in at a corner of the box and could leave on the other side of y.
        (plate(0.75), {"wind": (1.0, 1.0, 0.0), "open_faces": ("x-", "x+", "y-")}),
    ],
    ids=["from below", "from above", "at an angle"],
)
def test_wind_into_air_that_solids_cut_off_is_refused(obstacle, changes):
    face = "x[+]" if changes.get("wind", (1.0,))[0] < 0.0 else "x-"
    with pytest.raises(ValueError, match=f'smoke "plume": wind blows in through {face}.* cut air there off') as told:
        build(obstacles=[obstacle], **{"wind": (1.0, 0.0, 0.0), "open_faces": ("x-", "x+"), **changes})
    assert "leave a way around them, close the side, or turn the wind" in str(told.value)


@pytest.mark.parametrize(
    ("obstacle", "changes"),
    [
        # A way around it, two cells wide; and a side of the box beside it.
        (plate(0.75, size=(2.0 * CELL, 0.5, 2.0)), {}),
        (plate(0.75), {"open_faces": ("x-", "x+", "z+")}),
    ],
    ids=["a gap", "another side"],
)
def test_wind_past_solids_loses_no_air(obstacle, changes):
    solver = build(obstacles=[obstacle], **{"wind": (1.0, 0.0, 0.0), "open_faces": ("x-", "x+"), **changes})
    for _ in range(3):
        solver.substep(0.01)
    flow_in, flow_out = fluxes(solver)
    assert flow_in == pytest.approx(flow_out, rel=1.0e-3, abs=1.0e-6)
    assert solver.diagnostics()["not_converged"] == 0.0
