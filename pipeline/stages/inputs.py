"""What stages need to know about the world outside the job's folder: tool versions and the user's own files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from blake3 import blake3

from sim.scene import SceneParameters
from sim.shapes.parameters import MeshShape, Placement


@cache
def tool_version(package: str) -> str:
    """Installed version of a package, or "absent"; reads metadata, imports nothing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def mesh_file_hashes(placements: Iterator[Placement]) -> dict[str, str]:
    """Content hash of every mesh file that these bodies use, by path."""
    files = {placement.shape.file for placement in placements if isinstance(placement.shape, MeshShape)}
    return {Path(file).name: _hash(file, *_identity(file)) for file in sorted(files)}


def placements(scene: SceneParameters) -> Iterator[Placement]:
    """Every placed shape of a scene."""
    yield from scene.rigid
    for fluid in scene.fluid:
        yield from fluid.block
    for smoke in scene.smoke:
        yield from smoke.source


def _identity(file: str) -> tuple[int, int]:
    status = Path(file).stat()
    return status.st_size, status.st_mtime_ns


@cache
def _hash(file: str, _size: int, _mtime_ns: int) -> str:
    return blake3(Path(file).read_bytes()).hexdigest()
