"""The marks of tests that draw: they need Blender's module and the shared libraries that it loads, or more."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from render.system_libraries import missing_libraries
from render.workbench import EGL_PACKAGES

needs_bpy = pytest.mark.skipif(
    find_spec("bpy") is None or bool(missing_libraries()),
    reason=f"no bpy module for this Python, or shared libraries are missing: {missing_libraries()}",
)

needs_egl = pytest.mark.skipif(
    bool(missing_libraries(EGL_PACKAGES)), reason="Workbench draws through EGL: install libegl1 and libgl1-mesa-dri"
)
