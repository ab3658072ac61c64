"""OpenVDB for Python: an installed one, as executables of Blender have it, or the one inside the bpy wheel."""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, ModuleSpec
from pathlib import Path
from types import ModuleType


def import_openvdb() -> ModuleType:
    """The binding.

    Raises:
        RuntimeError: there is none, or it cannot be loaded.
    """
    if "openvdb" in sys.modules:
        return sys.modules["openvdb"]
    spec = importlib.util.find_spec("openvdb") or _spec_inside_bpy()
    if spec is None or spec.loader is None:
        raise RuntimeError(
            "OpenVDB is not installed: it comes inside the bpy wheel, which exists for Python 3.11 and 3.13 on "
            f"Linux and macOS; this is Python {sys.version_info.major}.{sys.version_info.minor} on {sys.platform}"
        )
    try:
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except ImportError as error:
        raise RuntimeError(f"{spec.origin} cannot be loaded: {error}") from error
    sys.modules["openvdb"] = module
    return module


def _spec_inside_bpy() -> ModuleSpec | None:
    # find_spec of a top-level package locates it without running it.
    bpy = importlib.util.find_spec("bpy")
    for folder in (bpy.submodule_search_locations or ()) if bpy else ():
        for suffix in EXTENSION_SUFFIXES:
            for file in sorted(Path(folder).glob(f"*/python/lib/python3.*/site-packages/openvdb{suffix}")):
                return importlib.util.spec_from_loader("openvdb", ExtensionFileLoader("openvdb", str(file)))
    return None
