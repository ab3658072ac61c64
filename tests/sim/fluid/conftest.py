"""A small dam break for all tests of the particle fluids."""

from collections.abc import Callable

import pytest
from small_fluids import lattice, make_fluid

from sim.core.domain import DomainParameters
from sim.fluid.fluid import SPHFluid


@pytest.fixture
def dam_break(taichi_cpu: str) -> Callable[..., SPHFluid]:
    """A dam of 6 x 6 x 10 particles at the end of a short channel."""

    def build(**parameters: object) -> SPHFluid:
        domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.4, 0.12, 0.4))
        return make_fluid(domain, lattice((0.0, 0.0, 0.0), (0.12, 0.12, 0.2), 0.02), **parameters)

    return build
