"""A farm of synthetic jobs for each test."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from farm_processes import Farm


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    farm = Farm(tmp_path)
    yield farm
    farm.close()
