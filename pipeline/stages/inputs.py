"""What stages need to know before they run: tool versions, the user's own files, and how large the scene may be."""

from __future__ import annotations

import errno
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from math import inf, pi, prod
from pathlib import Path
from typing import TypeVar

from blake3 import blake3

from pipeline.errors import MissingInputError, StageUnavailableError
from sim.cloth.parameters import ClothParameters, RectangleSheet
from sim.fluid.parameters import EmitterParameters, FluidParameters, RectangleOpening
from sim.scene import SceneParameters
from sim.shapes.parameters import BoxShape, MeshShape, Placement

ABSENT = "absent"
"""Version of a package that is not installed."""

P = TypeVar("P", Placement, ClothParameters)

MOST_IN_A_VOLUME = 1.5
"""Of a thin block or a narrow opening, whose last particles reach beyond it, as against what the volume tells."""


@cache
def tool_version(package: str) -> str:
    """Installed version of a package, or ABSENT; reads metadata, imports nothing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ABSENT


@cache
def blender_version(executable: str | None) -> str:
    """Version of the Blender that draws; wherever it lies, the same version gives the same frames.

    Raises:
        StageUnavailableError: the executable is not there, or not a Blender that can be used.
    """
    from render.blender import BlenderUnavailableError, require_supported_executable

    if executable is None:
        return tool_version("bpy")
    try:
        return ".".join(map(str, require_supported_executable(executable)))
    except BlenderUnavailableError as error:
        raise StageUnavailableError(f"render: {error}") from error


def by_content(placement: P) -> P:
    """The placement with its mesh file, if it has one, named by what is in it: where it lies has no effect.

    Raises:
        MissingInputError: the file cannot be read.
    """
    if not isinstance(placement.shape, MeshShape):
        return placement
    shape = placement.shape.model_copy(update={"file": content_name(placement.shape.file, "mesh")})
    return placement.model_copy(update={"shape": shape})


def bodies_by_content(scene: SceneParameters) -> dict[str, object]:
    """The scene's bodies for a fingerprint, mesh files named by their content.

    Raises:
        MissingInputError: a mesh file cannot be read.
    """
    return {
        "rigid": [by_content(body) for body in scene.rigid],
        "fluid": [fluid.model_copy(update={"block": tuple(map(by_content, fluid.block))}) for fluid in scene.fluid],
        "smoke": [smoke.model_copy(update={"source": tuple(map(by_content, smoke.source))}) for smoke in scene.smoke],
        "cloth": [by_content(cloth) for cloth in scene.cloth],
    }


def domain_volume(scene: SceneParameters) -> float:
    """Volume of the domain [m³]."""
    return prod(high - low for low, high in zip(scene.domain.min, scene.domain.max, strict=True))


def most_particles(scene: SceneParameters) -> float:
    """About the most particles of all fluids."""
    return sum(most_particles_of(fluid, scene) for fluid in scene.fluid)


def most_particles_of(fluid: FluidParameters, scene: SceneParameters, *, until_s: float = inf) -> float:
    """About the most particles of a fluid: what its blocks and emitters give, at most a domain full.

    Args:
        fluid: one of the scene's.
        scene: which has the domain.
        until_s: what flows in later does not count [s].
    """
    filled = sum(
        prod(block.shape.size) * block.scale**3 if isinstance(block.shape, BoxShape) else inf for block in fluid.block
    )
    emitted = sum(emitted_volume(emitter, until_s=until_s) for emitter in fluid.emitter)
    volume = min(MOST_IN_A_VOLUME * (filled + emitted), domain_volume(scene))
    return min(volume, fluid.most_volume) / fluid.lattice_volume


def emitted_volume(emitter: EmitterParameters, *, until_s: float) -> float:
    """What flows in until then [m³], as far as there is room."""
    opening = emitter.shape
    area = prod(opening.size) if isinstance(opening, RectangleOpening) else pi * opening.radius**2
    end_s = until_s if emitter.end_s is None else min(emitter.end_s, until_s)
    return area * emitter.speed * max(0.0, end_s - emitter.start_s)


def count_cloth_nodes(scene: SceneParameters) -> int:
    """How many nodes all cloths have, `count_nodes` of each.

    Raises:
        MissingInputError: a mesh file cannot be read, or holds no sheet.
    """
    return sum(count_nodes(cloth) for cloth in scene.cloth)


def count_nodes(cloth: ClothParameters) -> int:
    """Number of nodes; a mesh is read for it, once, as files of a size hold ten times as many or as few.

    Raises:
        MissingInputError: a mesh file cannot be read, or holds no sheet.
    """
    shape = cloth.shape
    if isinstance(shape, RectangleSheet):
        return prod(shape.node_counts)
    status = _status(shape.file, "mesh")
    return _nodes_of_mesh(shape, status.st_size, status.st_mtime_ns)


@cache
def _nodes_of_mesh(shape: MeshShape, _size: int, _mtime_ns: int) -> int:
    from sim.cloth.sheet import build_sheet
    from sim.shapes import ShapeError

    try:
        return len(build_sheet(shape).vertices)
    except ShapeError as error:
        raise MissingInputError(f"{error}; the job needs it") from error


def content_name(file: str, kind: str) -> str:
    """Hash and suffix of a file of the user's, for the suffix decides how the file is read.

    Args:
        file: its path.
        kind: what it is, for messages: "mesh".

    Raises:
        MissingInputError: it cannot be read.
    """
    status = _status(file, kind)
    return _hash(file, kind, status.st_size, status.st_mtime_ns) + Path(file).suffix.lower()


def _status(file: str, kind: str) -> os.stat_result:
    try:
        return Path(file).stat()
    except OSError as error:
        raise _missing(file, kind, error) from error


def _missing(file: str, kind: str, error: OSError) -> MissingInputError:
    return MissingInputError(f"cannot read the {kind} {file}: {error.strerror}; the job needs it")


@cache
def _hash(file: str, kind: str, _size: int, _mtime_ns: int) -> str:
    try:
        if not Path(file).is_file():
            raise OSError(errno.EINVAL, "it is no file", file)  # a device or a pipe may never end
        return blake3(Path(file).read_bytes()).hexdigest()
    except OSError as error:
        raise _missing(file, kind, error) from error
