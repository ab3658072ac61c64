"""glTF: one animated scene for the web in a binary file, .glb.

Metres, y up, seconds from the first frame. Bodies that move as a whole have one mesh and keyframes of their place;
sheets, whose faces stay, one mesh with a morph target a frame, blended in between; surfaces, whose faces change, one
mesh a frame, shown by a scale of one and hidden by zero. glTF has neither volumes nor spheres, and no zoom of a camera.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blender_scripts.ply import SurfaceMesh
from render.camera_path import SENSOR_WIDTH_MM, View
from render.errors import invalid_if_refused
from render.poses import Placement, the_short_way
from render.preview_looks import PreviewLook, preview_of
from render.spec import MeshObject, MeshSequenceObject, MovingMeshObject, RenderSpec

_MAGIC, _VERSION = b"glTF", 2
_JSON, _BINARY = b"JSON", b"BIN\0"
_DTYPES: dict[int, np.dtype[Any]] = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_VERTICES, _INDICES = 34962, 34963  # what a part of the file is for: targets of buffers, by OpenGL's numbers
_LARGEST_SHORT = 65_535  # as an index it has a meaning of its own


class TooLargeError(Exception):
    """The file would be larger than it may."""


def write_glb(
    path: Path,
    spec: RenderSpec,
    *,
    times: Sequence[float],
    meshes: Mapping[str, SurfaceMesh],
    sequences: Mapping[str, Iterable[SurfaceMesh]],
    placements: Mapping[str, Sequence[Placement]],
    views: Sequence[View],
    limit_bytes: int,
) -> None:
    """Write the scene; the same content gives the same bytes.

    Args:
        path: of the file.
        spec: the scene as the renderer is given it.
        times: of the frames, from 0 [s].
        meshes: bodies at rest, by object.
        sequences: a mesh a frame, by object; with `uv` they are of a sheet.
        placements: of bodies that move, one a frame, by object.
        views: of the camera, one a frame; one if it stands still.
        limit_bytes: the file's largest size.

    Raises:
        TooLargeError: it would be larger.
    """
    scene = _Scene(times, limit_bytes)
    smooth: dict[tuple[int, float], SurfaceMesh] = {}  # several bodies may have one mesh
    for drawn in spec.objects:
        look = preview_of(drawn.material)
        if isinstance(drawn, MeshObject | MovingMeshObject):
            angle = math.radians(drawn.shade_smooth_angle_deg)
            if isinstance(drawn, MeshObject):
                places: Sequence[Placement] = [Placement(drawn.position, drawn.orientation)]
            else:
                places = placements[drawn.name]
            mesh = meshes[drawn.name]
            if (id(mesh), angle) not in smooth:
                smooth[id(mesh), angle] = _smooth(mesh, angle)
            scene.add_body(drawn.name, look, smooth[id(mesh), angle], places)
        elif isinstance(drawn, MeshSequenceObject):
            scene.add_sequence(drawn.name, look, sequences[drawn.name])
    scene.add_camera(spec.render.resolution, views)
    path.write_bytes(scene.content())


def validate_glb(path: Path) -> None:
    """Decode a file fully: every array lies in it, numbers are finite, faces name vertices that there are.

    Raises:
        InvalidFileError: it is damaged.
        OSError: it cannot be read.
    """
    with invalid_if_refused(path):
        document, arrays = read_glb(path.read_bytes())
        for index, array in enumerate(arrays):
            if not np.isfinite(array).all():
                raise ValueError(f"accessor {index} holds values that are not finite")
        for mesh in document.get("meshes", ()):
            for part in mesh["primitives"]:
                if arrays[part["indices"]].max() >= len(arrays[part["attributes"]["POSITION"]]):
                    raise ValueError(f"mesh {mesh['name']} names a vertex that is not there")


def read_glb(content: bytes) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """The document of a file of this module, and the arrays of its accessors, (n,) or (n, columns).

    Raises:
        ValueError: it is damaged.
    """
    head = struct.Struct("<4sII")
    if len(content) < head.size or head.unpack_from(content) != (_MAGIC, _VERSION, len(content)):
        raise ValueError("is not a whole file of glTF 2.0")
    chunks: dict[bytes, bytes] = {}
    place = head.size
    while place < len(content):
        length, kind = struct.unpack_from("<I4s", content, place)
        chunks[kind] = content[place + 8 : place + 8 + length]
        place += 8 + length
    document = json.loads(chunks[_JSON])
    arrays = []
    for each in document.get("accessors", ()):
        view, columns = document["bufferViews"][each["bufferView"]], _COLUMNS[each["type"]]
        dtype: np.dtype[Any] = _DTYPES[each["componentType"]]
        array = np.frombuffer(chunks[_BINARY], dtype, each["count"] * columns, view["byteOffset"])
        arrays.append(array if columns == 1 else array.reshape(-1, columns))
    return document, arrays


class _Scene:
    """The document of a file, and the arrays that it names."""

    def __init__(self, times: Sequence[float], limit_bytes: int) -> None:
        self._parts: list[bytes] = []
        self._size, self._limit = 0, limit_bytes
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = []
        self._roots: list[int] = []
        self._meshes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._cameras: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._frame_times = np.asarray(times, np.float32)
        self._times = self._add(self._frame_times, bounds=True) if len(times) > 1 else None
        # of bodies, by mesh and look: the number, and the mesh itself, which keeps its identity
        self._of_bodies: dict[tuple[Any, ...], tuple[int, SurfaceMesh]] = {}
        self._shown: dict[int, tuple[int, int]] = {}  # times and scales that show a frame's meshes

    def add_body(self, name: str, look: PreviewLook, mesh: SurfaceMesh, places: Sequence[Placement]) -> None:
        """A mesh, at one place or at one a frame; bodies of one mesh and look share it in the file."""
        turns = _turns([place.orientation for place in places])
        where = _y_up([place.position for place in places])
        key = id(mesh), look.color, tuple(sorted(look.numbers.items()))
        shared = self._of_bodies.get(key)
        if shared is None:
            shared = self._add_mesh(name, mesh, self._add_material(name, look)), mesh
            self._of_bodies[key] = shared
        node = self._add_node(name, mesh=shared[0])
        self._place(node, where, turns)

    def add_sequence(self, name: str, look: PreviewLook, meshes: Iterable[SurfaceMesh]) -> None:
        """A mesh a frame."""
        frames = iter(meshes)
        first = next(frames)
        material = self._add_material(name, look, both_sides=first.uv is not None)
        if first.uv is not None:
            self._add_sheet(name, material, first, frames)
            return
        children = []
        for index, mesh in enumerate(chain([first], frames)):
            if len(mesh.faces):  # of an empty surface there is nothing to show
                shape = self._add_mesh(f"{name}.{index}", mesh, material)
                children.append(self._add_node(f"{name}.{index}", is_root=False, mesh=shape))
                self._show(children[-1], index)
        node = self._add_node(name)
        if children:
            self._nodes[node]["children"] = children

    def _add_sheet(self, name: str, material: int, first: SurfaceMesh, others: Iterator[SurfaceMesh]) -> None:
        mesh = self._add_mesh(name, first, material)
        targets = []
        for other in others:
            targets.append({"POSITION": self._add(_y_up(other.vertices - first.vertices), _VERTICES, bounds=True)})
            if first.normals is not None and other.normals is not None:
                targets[-1]["NORMAL"] = self._add(_y_up(other.normals - first.normals), _VERTICES)
        node = self._add_node(name, mesh=mesh)
        if targets:
            self._meshes[mesh]["primitives"][0]["targets"] = targets
            self._meshes[mesh]["weights"] = [0.0] * len(targets)
            weights = np.eye(len(targets) + 1, len(targets), -1, dtype=np.float32)  # a frame is its target and no other
            self._animate(node, "weights", self._times, self._add(weights.ravel()))

    def add_camera(self, resolution: tuple[int, int], views: Sequence[View]) -> None:
        """The camera; a zoom stays as it is at first."""
        width, height = resolution
        distances = [math.dist(view.look_at, view.position) for view in views]
        lens = {
            "aspectRatio": width / height,
            "yfov": 2.0 * math.atan(SENSOR_WIDTH_MM * min(1.0, height / width) / (2.0 * views[0].focal_length_mm)),
            "znear": 0.01 * min(distances),
            "zfar": 100.0 * max(distances),
        }
        self._cameras.append({"name": "camera", "type": "perspective", "perspective": lens})
        node = self._add_node("camera", camera=0)
        self._place(node, _y_up([view.position for view in views]), _turns_of_views(views))

    def content(self) -> bytes:
        """The file."""
        animation = {"name": "simulation", "channels": self._channels, "samplers": self._samplers}
        used = {name for each in self._materials for name in each.get("extensions", ())}
        document = {
            "asset": {"version": "2.0", "generator": "pipeline export"},
            "extensionsUsed": sorted(used),
            "scene": 0,
            "scenes": [{"nodes": self._roots}],
            "nodes": self._nodes,
            "meshes": self._meshes,
            "materials": self._materials,
            "cameras": self._cameras,
            "animations": [animation] if self._channels else [],
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}] if self._size else [],
        }
        there = {key: value for key, value in document.items() if value or value == 0}  # no list may be empty
        text = json.dumps(there, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
        chunks = [(_JSON, text + b" " * (-len(text) % 4))]
        if self._size:
            chunks.append((_BINARY, b"".join(self._parts)))
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", _MAGIC, _VERSION, 12 + len(body)) + body

    def _add(self, values: NDArray[Any], target: int | None = None, *, bounds: bool = False) -> int:
        """An accessor of an array, (n,) or (n, columns). Raises TooLargeError."""
        code = next(code for code, dtype in _DTYPES.items() if dtype == values.dtype)
        columns = values.shape[1] if values.ndim == 2 else 1
        data = np.ascontiguousarray(values).tobytes()
        data += b"\0" * (-len(data) % 4)
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": values.nbytes}
        self._views.append(view if target is None else {**view, "target": target})
        accessor = {
            "bufferView": len(self._views) - 1,
            "componentType": code,
            "count": len(values),
            "type": next(name for name, width in _COLUMNS.items() if width == columns),
        }
        if bounds:
            table = values.reshape(-1, columns)
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        self._accessors.append(accessor)
        self._parts.append(data)
        self._size += len(data)
        if self._size > self._limit:
            raise TooLargeError(f"more than {self._limit} bytes")
        return len(self._accessors) - 1

    def _add_node(self, name: str, *, is_root: bool = True, **content: Any) -> int:
        self._nodes.append({"name": name, **content})
        if is_root:
            self._roots.append(len(self._nodes) - 1)
        return len(self._nodes) - 1

    def _add_mesh(self, name: str, mesh: SurfaceMesh, material: int) -> int:
        attributes = {"POSITION": self._add(_y_up(mesh.vertices), _VERTICES, bounds=True)}
        if mesh.normals is not None:
            attributes["NORMAL"] = self._add(_y_up(mesh.normals), _VERTICES)
        indices = mesh.faces.ravel().astype("<u2" if len(mesh.vertices) <= _LARGEST_SHORT else "<u4")
        part = {"attributes": attributes, "indices": self._add(indices, _INDICES), "material": material}
        self._meshes.append({"name": name, "primitives": [part]})
        return len(self._meshes) - 1

    def _add_material(self, name: str, look: PreviewLook, *, both_sides: bool = False) -> int:
        numbers = look.numbers
        made: dict[str, Any] = {
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*look.color, 1.0],
                "metallicFactor": numbers.get("metallic", 0.0),
                "roughnessFactor": numbers["roughness"],
            },
            "doubleSided": both_sides,
        }
        extensions: dict[str, Any] = {}
        if "ior" in numbers:  # it refracts
            extensions["KHR_materials_transmission"] = {"transmissionFactor": 1.0}
            extensions["KHR_materials_ior"] = {"ior": numbers["ior"]}
        if "clearcoat" in numbers:
            extensions["KHR_materials_clearcoat"] = {"clearcoatFactor": numbers["clearcoat"]}
        self._materials.append({**made, "extensions": extensions} if extensions else made)
        return len(self._materials) - 1

    def _place(self, node: int, where: NDArray[np.float32], turns: NDArray[np.float32]) -> None:
        """Put a node at its first place, and move it on if there are more."""
        for path, values in (("translation", where), ("rotation", turns)):
            self._nodes[node][path] = values[0].tolist()
            if len(values) > 1:
                self._animate(node, path, self._times, self._add(values))

    def _show(self, node: int, frame: int) -> None:
        """Show a node at one frame alone, by its place among them."""
        self._nodes[node]["scale"] = [float(frame == 0)] * 3
        if self._times is None:
            return
        if frame not in self._shown:
            turning = [each for each in (frame, frame + 1) if 0 < each < len(self._frame_times)]
            scales = np.array([frame == 0, *(each == frame for each in turning)], np.float32)
            times = self._frame_times[[0, *turning]]
            self._shown[frame] = self._add(times, bounds=True), self._add(np.repeat(scales[:, None], 3, axis=1))
        self._animate(node, "scale", *self._shown[frame], interpolation="STEP")

    def _animate(self, node: int, path: str, times: int | None, values: int, *, interpolation: str = "LINEAR") -> None:
        self._channels.append({"sampler": len(self._samplers), "target": {"node": node, "path": path}})
        self._samplers.append({"input": times, "output": values, "interpolation": interpolation})


def _y_up(vectors: ArrayLike) -> NDArray[np.float32]:
    """Vectors of a world with z up, (n, 3), in one with y up."""
    x, y, z = np.asarray(vectors, np.float32).reshape(-1, 3).T
    return np.stack([x, z, -y], axis=1)


def _turns(quaternions: ArrayLike) -> NDArray[np.float32]:
    """Quaternions w, x, y, z of a world with z up, (n, 4), as x, y, z, w in one with y up."""
    short = the_short_way(quaternions)
    return np.column_stack([_y_up(short[:, 1:]), short[:, 0].astype(np.float32)])


def _turns_of_views(views: Sequence[View]) -> NDArray[np.float32]:
    """A camera's quaternions: it looks along its -z, its y is up."""
    from scipy.spatial.transform import Rotation

    axes = np.stack([_y_up(view.axes()).T for view in views])
    return the_short_way(Rotation.from_matrix(axes).as_quat()).astype(np.float32)


def _smooth(mesh: SurfaceMesh, angle: float) -> SurfaceMesh:
    """A mesh with normals, cut along edges that are sharper than an angle [rad]."""
    import trimesh

    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    cut = trimesh.graph.smooth_shade(whole, angle=angle, facet_minarea=None)
    normals = np.array(cut.vertex_normals)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)  # of faces without an area
    return SurfaceMesh(cut.vertices.astype(np.float32), cut.faces.astype(np.int32), normals.astype(np.float32))
