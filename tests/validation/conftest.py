"""One Taichi for all validation cases."""

import pytest

from sim.core.runtime import initialize


@pytest.fixture(scope="session")
def taichi_cpu() -> str:
    return initialize("cpu")
