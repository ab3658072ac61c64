"""The film that nobody disturbed: every other one must come out like it."""

from __future__ import annotations

from pathlib import Path

import pytest
from films import Finished, Studio


@pytest.fixture(scope="session")
def first_submit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Studio, Finished]:
    """The undisturbed film, and what its making printed. Look at it, but change nothing."""
    studio = Studio.open(tmp_path_factory.mktemp("reference"))
    return studio, studio.submit()


@pytest.fixture(scope="session")
def reference(first_submit: tuple[Studio, Finished]) -> Studio:
    """The undisturbed film. Look at it, but change nothing."""
    return first_submit[0]


@pytest.fixture
def finished(reference: Studio, tmp_path: Path) -> Studio:
    """A finished film of one's own."""
    return reference.copy(tmp_path)


@pytest.fixture
def empty(tmp_path: Path) -> Studio:
    """A job that was not submitted yet."""
    return Studio.open(tmp_path)
