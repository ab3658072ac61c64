"""One Taichi for all tests of the physics."""

import os

import pytest

from sim.core.runtime import initialize

DEVICE_VARIABLE = "PIPELINE_TEST_DEVICE"
"""Environment variable with the device to test on, where that is not the CPU: `PIPELINE_TEST_DEVICE=cuda pytest ...`.

Tests that compare numbers of threads are for the CPU."""


@pytest.fixture(scope="session")
def taichi_cpu() -> str:
    return initialize(os.environ.get(DEVICE_VARIABLE, "cpu"))
