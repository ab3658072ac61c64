"""Where tests keep compiled modules."""

import runpy
from pathlib import Path

import pytest


@pytest.mark.parametrize(("named", "base"), [("/elsewhere", "/elsewhere"), ("beside", "~/.cache"), ("", "~/.cache")])
def test_compiled_modules_are_kept_in_the_named_cache_unless_its_path_is_relative(monkeypatch, named, base):
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    folder = runpy.run_path(str(Path(__file__).with_name("conftest.py")))["bytecode_folder"]()
    assert folder == Path(base).expanduser() / "physics-pipeline" / "bytecode"
