"""The film that nobody disturbed: every other one must come out like it."""

from pathlib import Path

import pytest
from films import SPLASH, Finished, Studio


@pytest.fixture(scope="session")
def first_submit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Studio, Finished]:
    """The undisturbed film, and what its making printed. Look at it, but change nothing."""
    studio = Studio.open(tmp_path_factory.mktemp("reference"))
    return studio, studio.submit()


@pytest.fixture(scope="session")
def reference(first_submit: tuple[Studio, Finished]) -> Studio:
    """The undisturbed film. Look at it, but change nothing."""
    return first_submit[0]


@pytest.fixture(scope="session")
def splash(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    """The undisturbed film of water and a ball alone. Look at it, but change nothing."""
    studio = Studio.open(tmp_path_factory.mktemp("splash"), SPLASH)
    studio.submit()
    return studio


@pytest.fixture
def finished(reference: Studio, tmp_path: Path) -> Studio:
    """A finished film of one's own."""
    return reference.copy(tmp_path)


@pytest.fixture
def empty(tmp_path: Path) -> Studio:
    """A job of water and a ball alone that was not submitted yet."""
    return Studio.open(tmp_path, SPLASH)
