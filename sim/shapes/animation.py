"""Meshes that Alembic and USD files animate: how they move as a whole, and how they deform meanwhile."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.lib.format import read_array
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath
from sim.core.runtime import cache_folder
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import ALEMBIC, AnimationShape, Placement
from sim.shapes.solid import Points, ShapeError, TriangleMesh, boundary_edges

READER = Path(__file__).parents[2] / "blender_scripts" / "read_animation.py"
"""Run in a process of its own: Blender in that of a solver would be two programs in one memory."""
READER_VERSION = 1
"""Raised when the same file gives other arrays."""
USUAL_FPS = 24.0
"""Samples a second of an Alembic file, as long as the job does not say."""
RIGID_WITHIN = 2.0e-5
"""A mesh whose points move against each other by less, in its diagonals, is rigid: files have numbers of 24 bits."""
FLAT = 1.0e-9
"""Least volume of a mesh, in cubes of its diagonal."""
MOST_BOXES = 16
"""Around samples, of one animation."""
TOGETHER = 1.0e-6
"""Points that are never farther apart, in diagonals of the mesh, are one: seams of textures double them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnimatedSolid(MeshSolid):
    """The solid of an animation's first sample, about the centre of its bounding box, and how it goes on.

    A sample is the first one deformed about its own origin, then turned, then moved: x = p + R y. p and R fit best in
    the least squares of all points (Kabsch 1976), so that y has no more of the motion than what deforms the mesh.
    """

    times: NDArray[np.float64]  # of the samples, from the first on [s], (k,)
    positions: Points  # of its origin [m], (k, 3)
    orientations: NDArray[np.float64]  # unit quaternions, (k, 4)
    volumes: NDArray[np.float64]  # of the samples [m³], (k,)
    deformed: NDArray[np.float32] | None  # points about its own origin, (k, n, 3) [m]; None if it is rigid

    @property
    def centre(self) -> NDArray[np.float64]:
        """Where its origin is in the first sample [m], (3,)."""
        return self.positions[0]

    @property
    def duration_s(self) -> float:
        """From the first sample to the last [s]."""
        return float(self.times[-1])

    def points(self, number: int) -> Points:
        """The points of a sample, where the file has them [m], (n, 3)."""
        own = self.mesh.vertices if self.deformed is None else self.deformed[number]
        return self.positions[number] + rotation.rotated(self.orientations[number], own.astype(np.float64))


def path_of_animation(placement: Placement, shape: AnimationShape) -> KeyframePath:
    """The path of an animated body's origin. Raises as `load_animation`."""
    solid = load_animation(shape)
    turned = rotation.from_degrees(placement.rotation_deg)
    positions = np.asarray(placement.position) + placement.scale * rotation.rotated(turned, solid.positions)
    orientations = rotation.product(turned, solid.orientations)
    times = (shape.start_s + solid.times).tolist()
    return KeyframePath(times, positions, orientations, linear=shape.interpolation == "linear")


def boxes_of_animation(placement: Placement, shape: AnimationShape) -> list[NDArray[np.float64]]:
    """Boxes around the first and the last sample of an animated body, and some in between, (2, 3) each [m].

    Raises as `load_animation`.
    """
    solid = load_animation(shape)
    turned = rotation.matrices(rotation.from_degrees(placement.rotation_deg))
    boxes = []
    for number in np.unique(np.linspace(0, len(solid.times) - 1, MOST_BOXES).astype(np.int64)):
        points = solid.points(int(number)) @ turned.T * placement.scale + np.asarray(placement.position)
        boxes.append(np.stack([points.min(axis=0), points.max(axis=0)]))
    return boxes


def load_animation(shape: AnimationShape) -> AnimatedSolid:
    """The animated solid in a file, which is read once on a machine.

    Raises:
        ShapeError: the file is missing or unreadable, its faces change, or its mesh is open or inside out somewhere.
    """
    path = Path(shape.file)
    if not path.is_file():
        found = "is no file" if path.exists() else "does not exist; check the path"
        raise ShapeError(f'shape.file: must be an Alembic or USD file, "{path}" {found}')
    status = path.stat()
    return _load(path, shape.object, shape.fps, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _load(path: Path, name: str | None, fps: float | None, _size: int, _mtime_ns: int) -> AnimatedSolid:
    """The solid of a file in a state, read anew where its arrays are not kept."""
    rate = _rate_of(path, fps)
    with path.open("rb") as file:
        content = hashlib.file_digest(file, "sha256").hexdigest()
    key = hashlib.sha256(repr((READER_VERSION, content, name, rate)).encode()).hexdigest()
    kept = cache_folder() / "animations" / f"{key[:32]}.npz"
    arrays = _kept_arrays(kept)
    if arrays is None:
        _read_into(kept, path, name or "", rate)
        arrays = _kept_arrays(kept)
        if arrays is None:
            raise ShapeError(f'shape.file: what was read of "{path}" cannot be read back from {kept}; check that disk')
    return animated_solid(*arrays, label=path.name)


def _rate_of(path: Path, fps: float | None) -> float:
    """Samples a second of a file."""
    if path.suffix.lower().removeprefix(".") == ALEMBIC:
        return USUAL_FPS if fps is None else fps
    from pxr import Sdf, Tf, Usd

    try:
        layer = Sdf.Layer.FindOrOpen(str(path))
        return float(Usd.Stage.Open(layer).GetTimeCodesPerSecond())
    except Tf.ErrorException as error:
        raise ShapeError(f'shape.file: "{path}" is not a readable USD file; export it again') from error


def _kept_arrays(
    kept: Path,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]] | None:
    """Times, points and triangles that were read before; None where there are none, or no whole ones."""
    try:
        with ZipFile(kept) as archive:
            times, points, triangles = (
                read_array(archive.open(f"{name}.npy"), allow_pickle=False) for name in ("times", "points", "triangles")
            )
            return times, points, triangles
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None


def _read_into(kept: Path, path: Path, name: str, rate: float) -> None:
    """Have Blender read a file into an archive that appears as a whole."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=kept.parent, prefix=".reading-") as folder:
        out = Path(folder) / "animation.npz"
        command = [sys.executable, str(READER), str(path.resolve()), str(out), repr(rate), name]
        child = subprocess.run(command, capture_output=True, text=True, check=False, errors="replace")
        refusal = Path(f"{out}.txt")
        if refusal.is_file():
            raise ShapeError(f'shape.file: "{path}" {refusal.read_text(encoding="utf-8")}')
        if not out.is_file():
            last = (child.stderr.strip() or child.stdout.strip()).rpartition("\n")[2]
            raise ShapeError(
                f'shape.file: "{path}" could not be read by Blender, which ended with {child.returncode}: {last}; '
                "the package bpy must be installed: pip install bpy"
            )
        out.replace(kept)


def animated_solid(
    times: NDArray[np.float64], points: NDArray[np.float32], triangles: NDArray[np.int32], *, label: str
) -> AnimatedSolid:
    """The solid of samples at times [s], (k,), of points (k, n, 3) [m] and triangles (m, 3), which all share.

    Raises:
        ShapeError: the mesh is open, or in some sample flat or inside out; messages call it by its label.
    """
    if not len(triangles):
        raise ShapeError(f"{label} has no faces; a solid needs a surface, so export it as a mesh")
    points, triangles = _joined(points, triangles)
    open_edges = len(boundary_edges(triangles))
    if open_edges:
        raise ShapeError(
            f"{label} is open: {open_edges} edges have a face on one side alone; a mesh that deforms needs an inside, "
            "so close its holes, or give the sheet a thickness, in a modelling program"
        )
    volumes = np.array([TriangleMesh(each.astype(np.float64), triangles).signed_volume for each in points])
    warnings: tuple[str, ...] = ()
    if volumes[0] < 0.0:
        triangles, volumes = np.ascontiguousarray(triangles[:, ::-1]), -volumes
        warnings = (f"{label} was inside out; all of its {len(triangles)} faces were turned",)
    diagonal = float(np.linalg.norm(np.ptp(points[0], axis=0)))
    bad = volumes <= FLAT * diagonal**3
    if bad.any():
        number = int(np.argmax(bad))
        raise ShapeError(
            f"{label} encloses no volume at sample {number}, {times[number]:.4g} s after its first: it is flat there, "
            "or inside out; keep a thickness all through the animation"
        )
    positions, orientations, deformed = _rigid_parts(points.astype(np.float64))
    largest = float(np.abs(deformed - deformed[0]).max())
    return AnimatedSolid(
        TriangleMesh(deformed[0].copy(), triangles),
        warnings=warnings,
        times=times,
        positions=positions,
        orientations=orientations,
        volumes=volumes,
        deformed=deformed.astype(np.float32) if largest > RIGID_WITHIN * diagonal else None,
    )


def _joined(points: NDArray[np.float32], triangles: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Points that are in one place in every sample joined, and those that no face uses left out."""
    used, numbers = np.unique(triangles, return_inverse=True)
    points, triangles = points[:, used], numbers.reshape(triangles.shape).astype(np.int32)
    if not len(boundary_edges(triangles)):
        return points, triangles
    cell = TOGETHER * float(np.linalg.norm(np.ptp(points[0], axis=0)))
    rows = np.round((points - points[:1].min(axis=1)) / max(cell, np.finfo(np.float32).tiny)).astype(np.int64)
    _, first, joined = np.unique(
        np.moveaxis(rows, 1, 0).reshape(points.shape[1], -1), axis=0, return_index=True, return_inverse=True
    )
    return points[:, first], joined.reshape(-1)[triangles].astype(np.int32)


def _rigid_parts(points: NDArray[np.float64]) -> tuple[Points, NDArray[np.float64], NDArray[np.float64]]:
    """Positions, orientations and points without these, of samples of points (k, n, 3) [m]."""
    first = points[0]
    origin = 0.5 * (first.min(axis=0) + first.max(axis=0))
    middle = first.mean(axis=0)
    positions, orientations, local = [], [], np.empty_like(points)
    for number, sample in enumerate(points):
        own = sample.mean(axis=0)
        turned = _best_turn(first - middle, sample - own)
        place = own - turned @ (middle - origin)
        local[number] = (sample - place) @ turned
        positions.append(place)
        orientations.append(rotation.from_matrix(turned))
    return np.stack(positions), np.stack(orientations), local


def _best_turn(before: Points, after: Points) -> NDArray[np.float64]:
    """The rotation matrix that brings points (n, 3) about their mean nearest to others."""
    left, _, right = np.linalg.svd(after.T @ before)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    turned: NDArray[np.float64] = (left * signs) @ right
    return turned
