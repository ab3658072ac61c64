import numpy as np
import pytest
from smoke_scenes import CLOSED_BOX, OPEN_BOX, air_in, get_faces, set_faces, unit_grid

from sim.smoke.arrays import new_floats
from sim.smoke.forces import accelerate, upward
from sim.smoke.parameters import SmokeParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")


SOURCE = {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.5, 0.5, 0.5)}


def build(grid, *, confinement: float):
    """The air of a grid, and what accelerates it for a time [s]."""
    strengths = {"vorticity_confinement": confinement, "buoyancy_density": 0.5, "buoyancy_temperature": 0.03}
    parameters = SmokeParameters(name="air", source=[SOURCE], cell_size=grid.cell_size, **strengths)
    air, work = air_in(grid), tuple(new_floats(grid.size) for _ in range(4))
    return air.state, lambda dt: accelerate(air, parameters, (0.0, 0.0, -9.81), work, dt)


def test_confinement_spins_a_lone_vortex_up_by_what_the_formula_says():
    n, epsilon, dt, core = 32, 0.5, 0.01, 0.1
    grid = unit_grid((n, n, 8), CLOSED_BOX)
    (velocity, _, _), advance = build(grid, confinement=epsilon)

    def vortex(axis):
        """Lamb and Oseen's, of circulation 2 pi: all its vorticity turns the same way."""
        x, y, _ = (grid.face_centres(axis) - 0.5).T
        r_squared = x**2 + y**2
        swirl = -np.expm1(-r_squared / core**2) / r_squared
        return (np.array([-y, x, np.zeros_like(x)])[axis] * swirl).reshape(grid.face_shape(axis))

    set_faces(grid, velocity, [vortex(axis) for axis in range(3)])
    before = get_faces(grid, velocity)
    advance(dt)
    gained = [after - old for after, old in zip(get_faces(grid, velocity), before, strict=True)]
    torque = 0.0
    for axis, sign in ((0, -1.0), (1, 1.0)):
        position = (grid.face_centres(axis) - 0.5).reshape(*grid.face_shape(axis), 3)
        # The middle layer alone: near the lids no confinement acts.
        torque += float((sign * position[..., 1 - axis] * gained[axis])[:, :, 4].sum()) / n**2
    # omega = 2/a^2 exp(-r^2/a^2) falls outwards, so epsilon h (N x omega) pushes along the flow: the torque is
    # epsilon h times the integral of 2 pi r^2 omega, which is pi^(3/2) a.
    expected = dt * epsilon / n * np.pi**1.5 * core
    # Central differences and averages over a core of 3 cells flatten the vorticity's peak.
    assert torque == pytest.approx(expected, rel=0.05)
    # At the core's edge the flow is faster than it was.
    i = n // 2 + 2
    assert gained[1][i, n // 2, 4] > 0.0
    assert before[1][i, n // 2, 4] > 0.0


def test_buoyancy_is_alpha_and_beta_along_gravity_and_stops_at_walls():
    grid = unit_grid((8, 8, 8), OPEN_BOX)
    (velocity, density, excess), advance = build(grid, confinement=0.2)
    set_faces(grid, velocity, [np.zeros(grid.face_shape(axis)) for axis in range(3)])
    density.from_numpy(grid.pad(np.full(grid.cells, 0.4, np.float32)).ravel())
    excess.from_numpy(grid.pad(np.full(grid.cells, 50.0, np.float32)).ravel())
    advance(0.1)
    u, v, w = get_faces(grid, velocity)
    assert not u.any()
    assert not v.any()
    assert w[:, :, 1:-1] == pytest.approx(0.1 * (0.03 * 50.0 - 0.5 * 0.4), rel=1.0e-6)
    # The floor is a wall, the ceiling is open.
    assert not w[:, :, 0].any()
    assert (w[:, :, -1] > 0.0).all()


def test_up_is_against_gravity_and_nowhere_without_it():
    assert upward((0.0, 0.0, -9.81)) == pytest.approx((0.0, 0.0, 1.0))
    assert upward((3.0, 4.0, 0.0)) == pytest.approx((-0.6, -0.8, 0.0))
    assert upward((0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
