"""A fixed step of WCSPH through an impact: how stiff particles become that are pressed against walls."""

import numpy as np
import pytest
from small_fluids import lattice, make_fluid

from sim.core.domain import DomainParameters

SPACING, DT = 0.02, 1.0e-4


def stiffest(**material: object) -> float:
    """Largest frequency times the step [-] as a cube of 14³ particles falls onto a floor at 5 m/s."""
    domain = DomainParameters(min=(-0.6, -0.6, 0.0), max=(0.6, 0.6, 1.0))
    particles = lattice((-0.14, -0.14, 0.02), (0.14, 0.14, 0.3), SPACING)
    velocities = np.broadcast_to(np.float32((0.0, 0.0, -5.0)), particles.shape).copy()
    fluid = make_fluid(domain, particles, velocities, dt=DT, **material)
    largest = 0.0
    for _ in range(600):
        fluid.substep(DT)
        assert fluid.first_bad_quantity() is None
        largest = max(largest, DT * fluid.frequency_ratio * fluid.tank.motion.max_frequency)
    return largest


@pytest.mark.slow
def test_friction_at_walls_keeps_a_fixed_step_stable_through_an_impact(taichi_cpu):
    # Symplectic Euler bears 2. A fluid at rest has 1.1 c_s dt/d = 0.33 at 60 m/s, but a particle that is shot onto the
    # samples of a wall has 28 times the diagonal of one at rest, and is compressed by 15 %: 0.33 sqrt(28) 1.15³ = 2.7.
    assert stiffest(sound_speed=60.0) > 2.0
    # Artificial viscosity between fluid and wall takes its speed on the way.
    assert stiffest(sound_speed=45.0, artificial_viscosity=0.2, wall_friction=2.0) < 1.5
