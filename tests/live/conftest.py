"""One Taichi for the tests of what runs live."""

import pytest

from sim import runtime


@pytest.fixture(scope="session")
def taichi() -> None:
    """As other tests of this process have started it; else on one thread, as the stages' tests want it."""
    runtime.initialize("auto", threads=runtime._in_use.get("threads", 1))
