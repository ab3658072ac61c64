"""Open sides of the box: air comes and goes, and energy only goes."""

import numpy as np
import pytest
from smoke_scenes import OPEN_BOX

from sim.core.domain import DomainParameters
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

CELL = 1 / 16
NEVER_S = 1.0e6


def build(size=(1.0, 1.0, 1.0), **changes) -> SmokeSolver:
    """Smoke as cold as the air in a box of cells; its source never emits unless told otherwise."""
    idle = {"shape": {"type": "box", "size": size}, "position": [0.5 * edge for edge in size], "start_s": NEVER_S}
    parameters = SmokeParameters(**{"name": "fog", "cell_size": CELL, "source": [idle], "cooling": 0.0, **changes})
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=size)
    return SmokeSolver(parameters, domain=domain, gravity=(0.0, 0.0, -9.81))


def advance(solver: SmokeSolver, duration_s: float, largest: float = 1 / 24) -> float:
    """Advance by a time [s]; returns the largest speed on the way [m/s]."""
    end, speed = solver.time_s + duration_s, 0.0
    while solver.time_s < end - 1.0e-9:
        solver.substep(min(solver.stable_dt(), largest, end - solver.time_s))
        speed = max(speed, solver.diagnostics()["max_speed"])
    return speed


@pytest.mark.parametrize(
    ("open_faces", "duration_s"), [(("z+",), 4.0), (OPEN_BOX, 1.5)], ids=["open top", "all open but the floor"]
)
def test_cold_fog_is_never_faster_than_its_height_can_make_it(open_faces, duration_s):
    weight, height = 1.125, 1.0
    solver = build(open_faces=open_faces, buoyancy_density=weight)
    state = solver.checkpoint()
    # Uneven under a lid that is missing, so that some sinks and air comes in; even where it flows out at the sides.
    fog = np.random.default_rng(1).random(solver.grid.cells) if open_faces == ("z+",) else np.ones(solver.grid.cells)
    solver.restore({**state, "density": solver.grid.pad(fog.astype(np.float32))})
    # With p = 0 where air comes in: 6.0 m/s under the open top, 46 m/s two seconds later, and 1.8 m/s out of the sides.
    assert advance(solver, duration_s) < 1.1 * np.sqrt(2.0 * weight * height)


@pytest.mark.parametrize("steps", [4, 40])
def test_a_slug_of_air_slows_down_by_the_pressure_that_bernoulli_has_where_air_comes_in(steps):
    size, speed, duration_s = (1.0, 0.25, 0.25), 1.5, 0.5
    solver = build(size, open_faces=("x-", "x+"), buoyancy_density=0.0)
    state = solver.checkpoint()
    state["u_face_x"] = solver.grid.pad(np.full(solver.grid.face_shape(0), speed, np.float32))
    solver.restore(state)
    for _ in range(steps):
        solver.substep(duration_s / steps)
    u = solver.grid.trim(solver.checkpoint()["u_face_x"], solver.grid.face_shape(0))
    # du/dt = -u²/(2 L), which the splitting solves exactly whatever the step: up to 3 cells a step here.
    exact = speed / (1.0 + speed * duration_s / (2.0 * size[0]))
    assert u == pytest.approx(np.full_like(u, exact), rel=1.0e-4)


def test_air_comes_in_without_a_velocity_along_the_side():
    solver = build(open_faces=("z+",), buoyancy_density=0.0)
    grid = solver.grid
    inward, along, step = -0.5, 1.0, 0.25
    state = solver.checkpoint()
    state["w_face_z"] = grid.pad(np.full(grid.face_shape(2), inward, np.float32))
    state["u_face_x"] = grid.pad(np.full(grid.face_shape(0), along, np.float32))
    state["density"] = grid.pad(np.ones(grid.cells, np.float32))
    solver.restore(state)
    solver._transport.advance(step / abs(inward))
    solver._advection.advance(step * CELL / abs(inward))
    after = solver.checkpoint()
    # A quarter of a cell of clean air at rest has come into the last layer, and into no other.
    inner = grid.trim(after["u_face_x"], grid.face_shape(0))
    assert inner[..., -1] == pytest.approx(np.full_like(inner[..., -1], (1.0 - step) * along), rel=1.0e-5)
    assert inner[..., :-1] == pytest.approx(np.full_like(inner[..., :-1], along), rel=1.0e-5)
    # Nor is there smoke behind the walls, which air passes here.
    density = grid.trim(after["density"], grid.cells)[3:-3]
    assert density[..., -1] == pytest.approx(np.full_like(density[..., -1], 1.0 - step), rel=1.0e-5)


@pytest.mark.slow
def test_a_plume_leaves_through_an_open_top_as_it_rises_in_a_taller_box():
    fluxes = []
    for height in (1.0, 1.75):
        hot = {"shape": {"type": "sphere", "radius": 0.15}, "position": (0.5, 0.5, 0.25), "temperature": 393.0}
        solver = build((1.0, 1.0, height), open_faces=OPEN_BOX, source=[{**hot, "fluctuation": 0.0}])
        rising = 0.0
        for _ in range(16):
            advance(solver, 0.1, 1 / 48)
            arrays = solver.snapshots()["fog"].arrays
            # Four to two cells below the top of the lower box.
            rising += float((arrays["density"] * arrays["velocity"][..., 2])[:, :, 12:14].sum(dtype=np.float64))
        fluxes.append(rising)
    # In all: at a moment the two differ by up to 15 %, as the head of the plume comes by a little earlier or later.
    assert fluxes[0] == pytest.approx(fluxes[1], rel=0.03)
