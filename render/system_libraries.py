"""Shared libraries that the wheels take from the system, and the Debian packages that hold them.

`bpy` links against X11 and OpenGL even where it never opens a window, and `taichi` against X11, so their import fails
on a bare machine. `python -m render.system_libraries` prints the packages that are missing, and nothing if none is;
it imports the standard library only, as `./run` calls it to finish setting up.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable, Mapping

DEBIAN_PACKAGES: Mapping[str, str] = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libGL.so.1": "libgl1",
}
"""Library -> package; checked on a minimal Debian 12, where with these bpy imports and Cycles renders."""


def missing_libraries(libraries: Iterable[str] = DEBIAN_PACKAGES) -> list[str]:
    """Those that the dynamic linker cannot load. None are needed where the system is not Linux."""
    if not sys.platform.startswith("linux"):
        return []
    return [library for library in libraries if not _loads(library)]


def missing_packages() -> list[str]:
    """The Debian packages to install."""
    return [DEBIAN_PACKAGES[library] for library in missing_libraries()]


def install_line(packages: Iterable[str]) -> str:
    """The command that installs them."""
    return f"sudo apt-get install -y {' '.join(packages)}"


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    print(*missing_packages())
