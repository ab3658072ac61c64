"""One Taichi for the tests of what runs live."""

import pytest

from sim.core import runtime


@pytest.fixture(scope="session")
def taichi() -> None:
    """With as many threads as every other test of this process that starts it."""
    runtime.initialize("cpu")
