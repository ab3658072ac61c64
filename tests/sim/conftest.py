"""One Taichi for all tests of the physics."""

import pytest

from sim.runtime import initialize


@pytest.fixture(scope="session")
def taichi_cpu() -> str:
    return initialize("cpu")
