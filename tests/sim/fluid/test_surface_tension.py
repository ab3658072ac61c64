"""Surface tension after Akinci et al. 2013: drops become round, keep their momentum, and oscillate."""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial import ConvexHull
from small_fluids import EVERY_FACE, lattice, make_fluid, run

from sim.core.domain import DomainParameters
from sim.fluid.boundary import at_origin
from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.fluid.parameters import FluidParameters
from sim.fluid.solvers import SOLVERS
from sim.fluid.surface_tension import cohesion_rate, cohesion_stress, cohesion_stress_akinci2013
from sim.fluid.tank import FluidStart

SPACING = 1.0e-3
SPACE = DomainParameters(min=(-0.02,) * 3, max=(0.02,) * 3, open_faces=EVERY_FACE)
WATER = 0.072


def drop(particles, **parameters):
    options = {"surface_tension": WATER, "viscosity": 1.0e-4, "artificial_viscosity": 0.1, **parameters}
    return make_fluid(
        SPACE,
        particles,
        gravity=(0.0, 0.0, 0.0),
        particle_radius=SPACING / 2,
        surface_tension_model="akinci2013",
        **options,
    )


def position(fluid) -> np.ndarray:
    return fluid.snapshots()["water"].arrays["position"].astype(np.float64)


def isoperimetric_quotient(points: np.ndarray) -> float:
    """36 pi V²/A³ of the convex hull: 1 for a ball, 0.52 for a cube."""
    hull = ConvexHull(points)
    return float(36.0 * np.pi * hull.volume**2 / hull.area**3)


def test_a_cube_becomes_a_ball_and_stays_where_it_is(taichi_cpu):
    fluid = drop(lattice((-0.0035,) * 3, (0.0035,) * 3, SPACING))
    assert isoperimetric_quotient(position(fluid)) == pytest.approx(np.pi / 6.0, rel=1e-3)
    before, mass = position(fluid).mean(axis=0), fluid.diagnostics()["mass"]
    run(fluid, 0.03)
    now = fluid.diagnostics()
    # The hull of 343 points spread over a ball has 0.95; an octahedron, the next best that a cube passes, 0.60.
    assert isoperimetric_quotient(position(fluid)) > 0.9
    for axis in "xyz":
        # Pair forces cancel to float32 rounding; the corners of the cube moved at 0.3 m/s.
        assert abs(now[f"momentum_{axis}"]) < 1.0e-6 * 0.3 * mass
    np.testing.assert_allclose(position(fluid).mean(axis=0), before, atol=1.0e-3 * SPACING)
    assert now["max_compression"] < 0.01


def test_cohesion_pulls_beyond_its_neutral_distance_and_pushes_below_it(taichi_cpu):
    def approach(distance_in_spacings: float) -> float:
        pair = np.float32([[0.0, 0.0, 0.0], [distance_in_spacings * SPACING, 0.0, 0.0]])
        fluid = drop(pair, viscosity=0.0, artificial_viscosity=0.0)
        fluid.substep(1.0e-6)
        velocity = fluid.snapshots()["water"].arrays["velocity"]
        np.testing.assert_array_equal(velocity[0], -velocity[1])
        return float(velocity[0, 0])

    # C(r) = 0 where 2 (1-q)³ q³ = 1/64, which is q = 0.27 of two spacings.
    assert approach(0.4) < 0.0
    assert approach(0.7) > 0.0
    assert approach(1.0) > 0.0
    assert approach(2.05) == 0.0


@pytest.mark.slow
def test_a_drop_oscillates_with_the_period_of_its_surface_tension(taichi_cpu):
    points = lattice((-0.01,) * 3, (0.01,) * 3, SPACING)
    stretch = 1.25
    inside = (points[:, 0] ** 2 + points[:, 1] ** 2) * stretch + (points[:, 2] / stretch) ** 2 < (5.0 * SPACING) ** 2
    fluid = drop(points[inside], viscosity=0.0, artificial_viscosity=0.02)
    radius = (3.0 * fluid.particle_count * fluid.particle_volume / (4.0 * math.pi)) ** (1.0 / 3.0)
    # Rayleigh 1879, the mode of an ellipsoid: omega² = 8 sigma/(rho R³).
    period = 2.0 * math.pi / math.sqrt(8.0 * WATER / (1000.0 * radius**3))

    def elongation() -> float:
        x = position(fluid)
        spread = ((x - x.mean(axis=0)) ** 2).mean(axis=0)
        return float(spread[2] - 0.5 * (spread[0] + spread[1]))

    elongations = []
    for _ in range(56):
        run(fluid, period / 40.0)
        elongations.append(elongation())
    shortest = int(np.argmin(elongations))
    longest = shortest + int(np.argmax(elongations[shortest:]))
    # Past the ball, and three quarters of the way back at least: whether beyond depends on the last digits, which
    # processors differ in.
    assert elongations[shortest] < -0.05 * elongations[0]
    assert elongations[longest] > 0.25 * elongations[shortest]
    # Half a period lies between. Five particles to the radius, heavily damped, and each extreme is flat: 25 %.
    assert 2.0 * (longest - shortest) / 40.0 == pytest.approx(1.0, rel=0.25)


def test_walls_pull_by_adhesion(taichi_cpu):
    floor = DomainParameters(min=(-0.005, -0.005, 0.0), max=(0.005, 0.005, 0.01))

    def pull(adhesion: float) -> float:
        layer = lattice((-0.003, -0.003, 0.0), (0.003, 0.003, 0.001), SPACING) + np.float32((0, 0, 0.2 * SPACING))
        fluid = make_fluid(
            floor,
            layer,
            gravity=(0.0, 0.0, 0.0),
            particle_radius=SPACING / 2,
            surface_tension_model="akinci2013",
            surface_tension=WATER,
            adhesion=adhesion,
            artificial_viscosity=0.0,
        )
        fluid.substep(1.0e-6)
        return float(fluid.snapshots()["water"].arrays["velocity"][:, 2].mean())

    assert pull(1.0) < pull(0.0)


@pytest.mark.parametrize("solver", ["wcsph", "dfsph", "pcisph"])
def test_a_body_gets_the_momentum_that_adhesion_gives_the_fluid(taichi_cpu, solver):
    plate = lattice((-0.004, -0.004, -0.001), (0.004, 0.004, 0.0), SPACING) - np.float32((0.0, 0.0, 0.5 * SPACING))
    particles = lattice((-0.002, -0.002, 0.0), (0.002, 0.003, 0.002), SPACING) + np.float32((0.0, 0.0, 0.1 * SPACING))
    material = {
        "name": "water",
        "solver": solver,
        "block": [{"shape": {"type": "sphere", "radius": 1}}],
        "particle_radius": SPACING / 2,
        "surface_tension_model": "akinci2013",
        "surface_tension": WATER,
        "adhesion": 2.0,
        "artificial_viscosity": 0.0,
    }
    start = FluidStart(
        (FluidParameters.model_validate(material),),
        domain=SPACE,
        gravity=(0.0, 0.0, 0.0),
        positions=particles,
        velocities=np.zeros_like(particles),
        boundary=BoundarySamples.of_bodies(),
        moving=BoundarySamples.of_bodies(plate),
        body_count=1,
    )
    fluid = SOLVERS[solver](start)
    fluid.tank.move_bodies(at_origin(1), elapsed_s=0.0)
    for _ in range(10):  # more than forces wait for together
        fluid.substep(1.0e-5)
    impulse, _ = fluid.body_forces.take_impulses()
    momentum = np.array([fluid.diagnostics()[f"momentum_{axis}"] for axis in "xyz"])
    assert momentum[2] < 0.0  # it is pulled onto the plate, which is pulled up
    # Sums of float32, over hundreds of pairs.
    np.testing.assert_allclose(impulse[0], -momentum, atol=1e-5 * abs(momentum[2]))


def test_adhesion_without_its_model_is_refused():
    with pytest.raises(ValidationError, match='adhesion needs surface_tension_model = "akinci2013"'):
        FluidParameters.model_validate(
            {"name": "water", "adhesion": 1.0, "block": [{"shape": {"type": "sphere", "radius": 1}}]}
        )


def test_stress_and_frequency_of_cohesion_are_sums_over_the_lattice():
    # At the usual support 6, 12 and 8 neighbours at q = r/2: W = 2 (1-q)³/pi, C = 32/pi (1-q)³ q³/8.
    shells = [(6, 1.0), (12, math.sqrt(2.0)), (8, math.sqrt(3.0))]
    weights = [(count, r, 2.0 * (1.0 - r / 2.0) ** 3 / math.pi) for count, r in shells]
    assert cohesion_stress(2.0) == pytest.approx(sum(count * r**2 * w for count, r, w in weights) / 6.0)
    assert cohesion_rate(2.0) == pytest.approx(sum(count * w for count, _, w in weights))
    pulls = [(count, r / 2.0, 4.0 / math.pi * (1.0 - r / 2.0) ** 3 * (r / 2.0) ** 3) for count, r in shells]
    # V is d³ to 0.003 %.
    assert cohesion_stress_akinci2013(2.0) == pytest.approx(sum(n * q * c for n, q, c in pulls) / 6.0, rel=1e-4)
    # The more neighbours, the more of them pull at a particle as its surroundings do not move: all but its own share.
    assert [cohesion_rate(support) for support in (2.0, 4.0)] == pytest.approx([0.682, 0.960], abs=0.001)
    # In the limit of wide supports a sum is an integral: int r² W dV d/6 grows with the square of the support.
    assert cohesion_stress(8.0) / cohesion_stress(4.0) == pytest.approx(4.0, rel=0.01)
    assert cohesion_stress_akinci2013(8.0) == pytest.approx(cohesion_stress_akinci2013(4.0), rel=0.02)
