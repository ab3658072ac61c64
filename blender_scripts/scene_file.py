"""The whole scene of a job as a .blend file, which plays the job's own files by relative paths; its meshes as Alembic.

    blender --background --factory-startup --python scene_file.py -- SPEC FRAMES FILE

SPEC is the RenderSpec document in the job's folder, which a .blend file is meant for, FRAMES a JSON list of frame
numbers whose poses and views are there, FILE ends in .blend or .abc. Meshes and points are imported by geometry nodes,
frame by frame; places of bodies and camera, and the lamps of fires, are keyframes. No script is in the file. A line
`SCENE_SAVED` or `SCENE_FAILED reason` ends what is written.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

if __package__ in (None, ""):
    # Run by a Blender executable: the package is not on its path.
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy

from blender_scripts import camera, geometry, poses, volumes
from blender_scripts.errors import RenderInputError
from blender_scripts.keyframes import forget_keyframes, reach_of_motion
from blender_scripts.ply import FADE_S, KINDS
from blender_scripts.points import ATTRIBUTES
from blender_scripts.render_frames import SceneRenderer

WET_FILES = "blend/{name}/{{frame}}.ply"  # of fluids, with where they touch solids: below the job's folder


class SceneFile(SceneRenderer):
    """A scene that is saved instead of drawn."""

    def save_blend(self, frames: Sequence[int], path: Path) -> None:
        """Let the scene play these frames, and write it.

        Raises:
            RenderInputError: a file of a frame is missing or unfit.
        """
        self._animate(frames, "//", WET_FILES)
        self._animate_fires(frames)
        scene = bpy.context.scene
        scene.render.threads_mode = "AUTO"
        scene.render.filepath = "//"
        for image in bpy.data.images:
            if image.source == "FILE" and not image.packed_files:
                image.pack()
        bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True, relative_remap=False)

    def save_alembic(self, frames: Sequence[int], path: Path) -> None:
        """Write bodies, surfaces, cloths, whitewater as loose points, and the camera. Raises as `save_blend` does."""
        self._animate(frames, f"{self._folder}/", None)
        for blender_object in bpy.data.objects:
            is_drawn = blender_object.name not in self._of_set and blender_object.type == "MESH"
            blender_object.select_set(is_drawn or blender_object == self._camera)
            if "spheres" in blender_object.modifiers:
                blender_object.modifiers.remove(blender_object.modifiers["spheres"])
        bpy.ops.wm.alembic_export(
            filepath=str(path),
            start=min(frames),
            end=max(frames),
            selected=True,
            export_hair=False,
            as_background_job=False,
        )

    def _animate(self, frames: Sequence[int], base: str, wet_files: str | None) -> None:
        """Let the scene play these frames, from files whose paths begin with `base`."""
        scene = bpy.context.scene
        bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
        for description, blender_object in self._sequences:
            self._play(description, blender_object, frames, base + description["file"])
        for description, blender_object in self._fluids:
            file = wet_files.format(name=description["name"]) if wet_files else description["file"]
            self._play(description, blender_object, frames, base + file)
        self._animate_bodies(frames)
        self._animate_camera(frames)
        scene.frame_start, scene.frame_end = min(frames), max(frames)
        scene.frame_set(min(frames))

    def _play(self, description: dict[str, Any], blender_object: Any, frames: Sequence[int], file: str) -> None:
        if description["type"] == "volume_sequence":
            volumes.load_volume(blender_object.data, self._file(description["file"], min(frames)))
            volumes.play(blender_object.data, file, frames)
            return
        modifier = blender_object.modifiers.new("frames", "NODES")
        if description["type"] == "point_sequence":
            modifier.node_group = _points_of_frame(blender_object, file, description["kind"])
            blender_object.modifiers.move(len(blender_object.modifiers) - 1, 0)
        else:
            geometry.fill_mesh(blender_object.data, geometry.EMPTY_MESH)
            modifier.node_group = _mesh_of_frame(blender_object, file)

    def _animate_bodies(self, frames: Sequence[int]) -> None:
        scene = bpy.context.scene
        fps = scene.render.fps / scene.render.fps_base
        before: dict[str, Any] = {}
        for frame in frames:
            places = self._place_bodies(frame)
            for description, blender_object in self._bodies:
                if frame == frames[0]:
                    forget_keyframes(blender_object)
                pose = places[description["name"]]
                for offset in _offsets():
                    position, orientation = pose.after(offset / fps)
                    last = before.get(blender_object.name)
                    if last is not None and float(last @ orientation) < 0.0:
                        orientation = -orientation
                    before[blender_object.name] = orientation
                    _key(blender_object, frame + offset, location=position, rotation_quaternion=orientation)

    def _is_covered(self, description: dict[str, Any]) -> bool:  # noqa: ARG002
        """Never: it is not told of each frame where liquids cover a body, and their surfaces are whole beside it."""
        return False

    def _place_bodies(self, frame: int) -> dict[str, poses.Pose]:
        return self._read_places(frame)

    def _animate_camera(self, frames: Sequence[int]) -> None:
        if self._views is None:
            return
        lens, cycles, before = self._camera.data, bpy.context.scene.cycles, None
        for frame in frames:
            for view in camera.read_views(self._file(self._views, frame)):
                if view["offset"] not in _offsets():
                    continue
                camera.set_view(self._camera, view)
                orientation = self._camera.rotation_quaternion.copy()
                if before is not None and before.dot(orientation) < 0.0:
                    orientation.negate()
                before = orientation
                time = frame + view["offset"]
                _key(self._camera, time, location=self._camera.location.copy(), rotation_quaternion=orientation)
                for name in ("lens", "dof.focus_distance"):
                    lens.keyframe_insert(name, frame=time)
            cycles.seed = self.seed_of(frame)
            bpy.context.scene.keyframe_insert("cycles.seed", frame=frame)

    def _animate_fires(self, frames: Sequence[int]) -> None:
        volumes_of = {description["name"]: description["file"] for description, _ in self._sequences}
        for name, fire in self._fires.items():
            for frame in frames:
                there = len(fire.lamps)
                fire.shine(self._file(volumes_of[name], frame))
                for index, lamp in enumerate(fire.lamps):
                    if index >= there and frame > frames[0]:  # before this frame it was not needed
                        _key(lamp, frame - 1, hide_render=True, hide_viewport=True)
                        lamp.hide_render = False
                    _key(lamp, frame, hide_render=lamp.hide_render, hide_viewport=lamp.hide_render)
                    _key(lamp, frame, location=lamp.location.copy())
                    data = lamp.data
                    _key(data, frame, energy=data.energy, color=data.color.copy())
                    _key(data, frame, shadow_soft_size=data.shadow_soft_size)


def _offsets() -> tuple[float, ...]:
    """Times of keyframes from their frame [frames]: where Cycles looks while the shutter is open."""
    reach = reach_of_motion()
    return (-reach, 0.0, reach) if 0.0 < reach <= 0.5 else (0.0,)


def _key(animated: Any, time: float, **values: Any) -> None:
    for name, value in values.items():
        setattr(animated, name, value)
        animated.keyframe_insert(name, frame=time)


# --- geometry nodes ---


class _Nodes:
    """A tree of geometry nodes that makes the geometry of the scene's frame."""

    def __init__(self, name: str) -> None:
        self.group = bpy.data.node_groups.new(f"{name} frames", "GeometryNodeTree")
        self.group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
        self.group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def node(self, kind: str, *inputs: Any, **settings: Any) -> Any:
        """A node with these settings; inputs are values, or sockets to link; None: as it is."""
        made = self.group.nodes.new(kind)
        for key, value in settings.items():
            setattr(made, key, value)
        for socket, value in zip(_shown(made.inputs), inputs, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.group.links.new(value, socket)
            elif value is not None:
                socket.default_value = value
        return made

    def imported(self, file: str) -> Any:
        """The geometry of a PLY file, whose path has {frame} in it."""
        time = self.node("GeometryNodeInputSceneTime")
        frame = self.node("FunctionNodeFloatToInt", time.outputs["Frame"], rounding_mode="ROUND")
        text = self.node("FunctionNodeFormatString")
        text.format_items.new("INT", "frame")
        text.inputs["Format"].default_value = file.replace("{frame}", "{frame:06}")
        self.group.links.new(frame.outputs[0], text.inputs["frame"])
        return self.node("GeometryNodeImportPLY", text.outputs[0]).outputs[0]

    def named(self, name: str, kind: str = "FLOAT") -> Any:
        """An attribute of the geometry."""
        return next(_shown(self.node("GeometryNodeInputNamedAttribute", name, data_type=kind).outputs))

    def stored(self, geometry_socket: Any, name: str, value: Any, kind: str, domain: str = "POINT") -> Any:
        """The geometry with an attribute more."""
        node = self.node(
            "GeometryNodeStoreNamedAttribute", geometry_socket, None, name, value, data_type=kind, domain=domain
        )
        return node.outputs[0]

    def with_velocity(self, geometry_socket: Any) -> Any:
        """The geometry with `velocity`, along which Cycles blurs, of the columns of the file."""
        vector = self.node("ShaderNodeCombineXYZ", *(self.named(name) for name in ("vx", "vy", "vz")))
        return self.stored(geometry_socket, "velocity", vector.outputs[0], "FLOAT_VECTOR")

    def end(self, geometry_socket: Any) -> Any:
        """Make this the result; returns the tree."""
        self.node("NodeGroupInput")
        self.node("NodeGroupOutput", geometry_socket)
        return self.group


def _shown(sockets: Any) -> Iterator[Any]:
    return (socket for socket in sockets if socket.enabled)


def _mesh_of_frame(blender_object: Any, file: str) -> Any:
    nodes = _Nodes(blender_object.name)
    mesh = nodes.with_velocity(nodes.imported(file))
    mesh = nodes.stored(mesh, geometry.REST_UV, nodes.named("UVMap", "FLOAT_VECTOR"), "FLOAT2", "CORNER")
    material = blender_object.data.materials[0]
    return nodes.end(nodes.node("GeometryNodeSetMaterial", mesh, None, material).outputs[0])


def _points_of_frame(blender_object: Any, file: str, kind: str) -> Any:
    """The points of one kind, with the radius that they have at the end of their life."""
    nodes = _Nodes(blender_object.name)
    points = nodes.with_velocity(nodes.imported(file))
    is_other = nodes.node(
        "FunctionNodeCompare",
        nodes.named("kind"),
        float(KINDS.index(kind)),
        0.5,
        data_type="FLOAT",
        operation="NOT_EQUAL",
    )
    is_other.inputs["Epsilon"].default_value = 0.5
    points = nodes.node("GeometryNodeDeleteGeometry", points, is_other.outputs[0], domain="POINT").outputs[0]
    share = nodes.node("ShaderNodeMath", nodes.named("lifetime"), FADE_S, operation="DIVIDE", use_clamp=True)
    fade = nodes.node("ShaderNodeMath", share.outputs[0], 1.0 / 3.0, operation="POWER")
    radius = nodes.node("ShaderNodeMath", nodes.named("radius"), fade.outputs[0], operation="MULTIPLY")
    points = nodes.stored(points, "radius", radius.outputs[0], "FLOAT")
    for column, attribute in ATTRIBUTES.items():
        if column != attribute:
            points = nodes.stored(points, attribute, nodes.named(column), "FLOAT")
    return nodes.end(points)


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit code."""
    spec, frames, path = arguments
    try:
        scene = SceneFile(Path(spec), threads=1, gpu=None)
        save = scene.save_alembic if path.endswith(".abc") else scene.save_blend
        save(json.loads(frames), Path(path))
    except (RenderInputError, RuntimeError, OSError, ValueError) as error:
        sys.stdout.write(f"SCENE_FAILED {str(error).replace(chr(10), ' ')}\n")
        return 1
    sys.stdout.write("SCENE_SAVED\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
