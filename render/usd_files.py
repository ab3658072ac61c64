"""Universal Scene Description: a layer of each frame, and the scene that plays them as value clips.

Metres, z up, time codes are frames. What changes shape has its samples in the layers of the frames; bodies that move
as a whole have one mesh, with samples of their place in the scene; smoke is OpenVDB files, by relative paths. Materials
are preview surfaces. Nothing of the set is in it: neither ground nor lamps.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blender_scripts.ply import SurfaceMesh
from render.camera_path import SENSOR_WIDTH_MM, View
from render.errors import InvalidFileError
from render.parameters import MaterialParameters
from render.poses import Placement, the_short_way
from render.preview_looks import PreviewLook, preview_of
from render.spec import (
    MeshObject,
    MeshSequenceObject,
    MovingMeshObject,
    PointSequenceObject,
    RenderSpec,
    VolumeSequenceObject,
)
from render.suffixed import read_as, written_as

WORLD = "/World"
RESERVED = ("camera", "Materials")
"""Names below `WORLD` that no object may have."""
_FIELDS = (("density", "float", ""), ("temperature", "float", ""), ("velocity", "vector", "vector"))
"""Grids of a smoke's files: name, kind of values, role of vectors."""


@dataclass(frozen=True)
class Points:
    """Points at one frame: positions [m] (n, 3), velocities [m/s] (n, 3), radii [m] (n,), identifiers (n,) or None."""

    position: ArrayLike
    velocity: ArrayLike
    radius: ArrayLike
    ids: ArrayLike | None = None


def write_usd_frame(
    path: Path, frame: int, *, meshes: Mapping[str, SurfaceMesh], points: Mapping[str, Points], guides: Sequence[str]
) -> None:
    """Write what changes shape, at one frame; `guides` are names of points that are not drawn."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory("frame.usdc")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
    for name, mesh in meshes.items():
        made = _define_mesh(stage, name)
        _fill_shape(made, mesh, frame)
        if mesh.uv is None:  # the faces of a sheet are the same in every frame
            _fill_faces(made, mesh, frame)
    for name, cloud in points.items():
        spheres = _define_points(stage, name, is_guide=name in guides)
        position = _vectors(cloud.position)
        spheres.CreatePointsAttr().Set(position, frame)
        spheres.CreateVelocitiesAttr().Set(_vectors(cloud.velocity), frame)
        spheres.CreateWidthsAttr().Set(_numbers(2.0 * np.asarray(cloud.radius, np.float32)), frame)
        if cloud.ids is not None:
            spheres.CreateIdsAttr().Set(_whole_numbers(cloud.ids), frame)
        spheres.CreateExtentAttr().Set(_extent(cloud.position, cloud.radius), frame)
    _save(stage.GetRootLayer(), path, ".usdc")


def write_usd_scene(
    path: Path,
    manifest: Path,
    spec: RenderSpec,
    *,
    frames: Mapping[int, str],
    meshes: Mapping[str, SurfaceMesh],
    placements: Mapping[str, Mapping[int, Placement]],
    views: Mapping[int, View],
    guides: Mapping[str, MaterialParameters],
    manifest_name: str,
    first_layer: Path,
) -> None:
    """Write the scene that plays the layers of frames, and the manifest of what they have.

    Args:
        path: of the scene.
        manifest: path of the manifest.
        spec: the scene as the renderer is given it.
        frames: the layers of frames, relative to the scene.
        meshes: bodies at rest, and the sheets of the first frame, by object.
        placements: of bodies that move, by object and frame.
        views: of the camera by frame; one for all if it stands still.
        guides: points beside the objects, by name, with materials.
        manifest_name: path of the manifest relative to the scene.
        first_layer: the layer of any frame.
    """
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory("scene.usdc")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(spec.fps)
    stage.SetFramesPerSecond(spec.fps)
    stage.SetStartTimeCode(min(frames))
    stage.SetEndTimeCode(max(frames))
    world = UsdGeom.Xform.Define(stage, WORLD).GetPrim()
    stage.SetDefaultPrim(world)
    Usd.ModelAPI(world).SetKind("component")
    for drawn in spec.objects:
        prim = _add_object(stage, drawn, meshes, placements.get(drawn.name, {}), frames)
        prim.SetDisplayName(drawn.name)
        _paint(stage, prim, drawn.name, preview_of(drawn.material))
    for name, material in guides.items():
        prim = _define_points(stage, name, is_guide=True).GetPrim()
        prim.SetDisplayName(name)
        _paint(stage, prim, name, preview_of(material))
    _add_camera(stage, spec, views)

    with read_as(first_layer, ".usdc") as named:
        layer = Sdf.Layer.OpenAsAnonymous(str(named))
    _forget_samples(layer)
    _save(layer, manifest, ".usda")
    clips = Usd.ClipsAPI(world)
    times = sorted(frames)
    clips.SetClipPrimPath(WORLD)
    clips.SetClipAssetPaths([Sdf.AssetPath(f"./{frames[frame]}") for frame in times])
    clips.SetClipActive([(frame, index) for index, frame in enumerate(times)])
    clips.SetClipTimes([(frame, frame) for frame in times])
    clips.SetClipManifestAssetPath(Sdf.AssetPath(f"./{manifest_name}"))
    _save(stage.GetRootLayer(), path, ".usdc")


def validate_usd(path: Path) -> None:
    """Decode a layer fully; every number is finite.

    Raises:
        InvalidFileError: it is damaged.
        OSError: it cannot be read.
    """
    from pxr import Sdf, Tf

    with path.open("rb") as file:
        suffix = ".usdc" if file.read(8) == b"PXR-USDC" else ".usda"
    with read_as(path, suffix) as named:
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(named))
            if layer is None:
                raise InvalidFileError(path, "cannot be opened as a layer of USD")
            _require_finite(path, layer)
        except Tf.ErrorException as error:
            raise InvalidFileError(path, f"USD cannot read it: {error}") from error


def _require_finite(path: Path, layer: Any) -> None:
    def look(place: Any) -> None:
        if not place.IsPropertyPath():
            return
        for time in layer.ListTimeSamplesForPath(place):
            values = np.asarray(layer.QueryTimeSample(place, time))
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise InvalidFileError(path, f"{place} holds values that are not finite")

    layer.Traverse("/", look)


def _forget_samples(layer: Any) -> None:
    def forget(place: Any) -> None:
        if place.IsPropertyPath():
            for time in layer.ListTimeSamplesForPath(place):
                layer.EraseTimeSample(place, time)

    layer.Traverse("/", forget)


def _save(layer: Any, path: Path, suffix: str) -> None:
    with written_as(path, suffix) as named:
        layer.Export(str(named))


# --- prims ---


def prim_name(name: str) -> str:
    """Name of the prim of an object: ASCII letters, digits and `_`, as all readers take them.

    Others are left out, and the end of a digest tells such names apart; `displayName` has them whole.
    """
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    end = "" if name.isascii() else f"_{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return re.sub(r"\W", "_", plain, flags=re.ASCII) + end


def _place_of(name: str) -> str:
    return f"{WORLD}/{prim_name(name)}"


def _define_mesh(stage: Any, name: str) -> Any:
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh.Define(stage, _place_of(name))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return mesh


def _define_points(stage: Any, name: str, *, is_guide: bool) -> Any:
    from pxr import UsdGeom

    points = UsdGeom.Points.Define(stage, _place_of(name))
    if is_guide:
        points.CreatePurposeAttr(UsdGeom.Tokens.guide)
    return points


def _add_object(
    stage: Any,
    drawn: Any,
    meshes: Mapping[str, SurfaceMesh],
    placements: Mapping[int, Placement],
    frames: Mapping[int, str],
) -> Any:
    """The prim of an object of the scene."""
    if isinstance(drawn, MeshObject | MovingMeshObject):
        mesh = _define_mesh(stage, drawn.name)
        _fill_shape(mesh, meshes[drawn.name], None)
        _fill_faces(mesh, meshes[drawn.name], None)
        _move(mesh, {None: drawn} if isinstance(drawn, MeshObject) else placements)
        return mesh.GetPrim()
    if isinstance(drawn, MeshSequenceObject):
        mesh = _define_mesh(stage, drawn.name)
        if drawn.name in meshes:
            _fill_faces(mesh, meshes[drawn.name], None)
        return mesh.GetPrim()
    if isinstance(drawn, PointSequenceObject):
        return _define_points(stage, drawn.name, is_guide=False).GetPrim()
    return _add_volume(stage, drawn, frames)


def _add_volume(stage: Any, drawn: VolumeSequenceObject, frames: Mapping[int, str]) -> Any:
    from pxr import Sdf, UsdVol

    volume = UsdVol.Volume.Define(stage, _place_of(drawn.name))
    volume.CreateExtentAttr([drawn.box_min, drawn.box_max])
    for grid, _, role in _FIELDS:
        field = UsdVol.OpenVDBAsset.Define(stage, f"{_place_of(drawn.name)}/{grid}")
        field.CreateFieldNameAttr(grid)
        if role:
            field.CreateVectorDataRoleHintAttr("Vector")
        file = field.CreateFilePathAttr()
        for frame in frames:
            file.Set(Sdf.AssetPath("./" + drawn.file.replace("{frame}", f"{frame:06d}")), frame)
        volume.CreateFieldRelationship(grid, field.GetPath())
    return volume.GetPrim()


def _fill_shape(made: Any, mesh: SurfaceMesh, frame: int | None) -> None:
    from pxr import UsdGeom

    time = _time(frame)
    made.CreatePointsAttr().Set(_vectors(mesh.vertices), time)
    if mesh.normals is not None:
        made.CreateNormalsAttr().Set(_vectors(mesh.normals), time)
        made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if mesh.velocities is not None:
        made.CreateVelocitiesAttr().Set(_vectors(mesh.velocities), time)
    made.CreateExtentAttr().Set(_extent(mesh.vertices, 0.0), time)


def _fill_faces(made: Any, mesh: SurfaceMesh, frame: int | None) -> None:
    from pxr import Sdf, UsdGeom, Vt

    time = _time(frame)
    made.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)), time)
    made.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(_plain(mesh.faces, np.int32).ravel()), time)
    for uv, interpolation in ((mesh.uv, UsdGeom.Tokens.vertex), (mesh.corner_uv, UsdGeom.Tokens.faceVarying)):
        if uv is not None:
            primvars = UsdGeom.PrimvarsAPI(made)
            coordinates = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
            coordinates.Set(Vt.Vec2fArray.FromNumpy(_plain(uv, np.float32).reshape(-1, 2)), time)


def _move(made: Any, placements: Mapping[Any, MeshObject | Placement]) -> None:
    """Samples of a body's place by frame, None for all; turns go the short way from frame to frame."""
    from pxr import Gf

    translate, orient = made.AddTranslateOp(), made.AddOrientOp()
    turns = the_short_way([place.orientation for place in placements.values()])
    for (frame, place), turn in zip(placements.items(), turns, strict=True):
        translate.Set(Gf.Vec3d(*map(float, place.position)), _time(frame))
        orient.Set(Gf.Quatf(*turn.tolist()), _time(frame))


def _add_camera(stage: Any, spec: RenderSpec, views: Mapping[int, View]) -> None:
    """The camera, whose lens and sensor USD has in tenths of a unit, here of a metre."""
    from pxr import Gf, UsdGeom

    camera = UsdGeom.Camera.Define(stage, f"{WORLD}/{RESERVED[0]}")
    width, height = spec.render.resolution
    longer = SENSOR_WIDTH_MM / 100.0
    camera.CreateHorizontalApertureAttr(longer * min(1.0, width / height))
    camera.CreateVerticalApertureAttr(longer * min(1.0, height / width))
    camera.CreateFStopAttr(spec.camera.f_stop or 0.0)
    camera.CreateShutterOpenAttr(-0.5 * spec.render.shutter if spec.render.motion_blur else 0.0)
    camera.CreateShutterCloseAttr(0.5 * spec.render.shutter if spec.render.motion_blur else 0.0)
    distances = [float(np.linalg.norm(np.subtract(view.look_at, view.position))) for view in views.values()]
    camera.CreateClippingRangeAttr(Gf.Vec2f(1e-3 * min(distances), 1e3 * max(distances)))
    place = camera.AddTransformOp()
    length, focus = camera.CreateFocalLengthAttr(), camera.CreateFocusDistanceAttr()
    for frame, view in views.items():
        time = _time(None if len(views) == 1 else frame)
        place.Set(_looking(view), time)
        length.Set(view.focal_length_mm / 100.0, time)
        focus.Set(view.focus_distance, time)


def _looking(view: View) -> Any:
    """From the camera's axes, right, up and back, to the world's."""
    from pxr import Gf

    rows = np.eye(4)
    rows[:3, :3] = view.axes()
    rows[3, :3] = view.position
    return Gf.Matrix4d(*rows.ravel().tolist())


def _paint(stage: Any, prim: Any, name: str, look: PreviewLook) -> None:
    """Bind a preview surface; the colour of the prim is its own, too."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade

    place = f"{WORLD}/{RESERVED[1]}/{_place_of(name).rpartition('/')[2]}"
    UsdGeom.Scope.Define(stage, f"{WORLD}/{RESERVED[1]}")
    material = UsdShade.Material.Define(stage, place)
    shader = UsdShade.Shader.Define(stage, f"{place}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    color = Gf.Vec3f(*look.color)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(color)
    for key, value in look.numbers.items():
        shader.CreateInput(key, Sdf.ValueTypeNames.Float).Set(value)
    output = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    if prim.IsA(UsdGeom.Gprim):
        UsdGeom.Gprim(prim).CreateDisplayColorAttr([color])


# --- values ---


def _time(frame: int | None) -> Any:
    from pxr import Usd

    return Usd.TimeCode.Default() if frame is None else Usd.TimeCode(frame)


def _plain(values: ArrayLike, dtype: Any) -> NDArray[Any]:
    """As USD takes arrays: parts of a file's content may lie where numbers of theirs should not."""
    return np.require(values, dtype, ["C", "ALIGNED"])


def _vectors(values: ArrayLike) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(_plain(values, np.float32).reshape(-1, 3))


def _numbers(values: ArrayLike) -> Any:
    from pxr import Vt

    return Vt.FloatArray.FromNumpy(_plain(values, np.float32))


def _whole_numbers(values: ArrayLike) -> Any:
    from pxr import Vt

    return Vt.Int64Array.FromNumpy(_plain(values, np.int64))


def _extent(positions: ArrayLike, radii: ArrayLike) -> Any:
    """Corners of the box around points of these radii [m]."""
    rows = np.asarray(positions, np.float32).reshape(-1, 3)
    if not len(rows):
        return _vectors(np.zeros((2, 3)))
    reach = np.broadcast_to(np.asarray(radii, np.float32), len(rows))[:, None]
    return _vectors(np.stack([(rows - reach).min(axis=0), (rows + reach).max(axis=0)]))
