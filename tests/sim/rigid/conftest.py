"""Contacts of rigid bodies are solved by kernels."""

import pytest


@pytest.fixture(autouse=True)
def _taichi(taichi_cpu: str) -> None:
    """Every test of rigid bodies may have contacts."""
