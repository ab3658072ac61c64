"""Draw frames of a RenderSpec: as a class inside the bpy module, as a script that is asked for them.

    blender --background --factory-startup --python render_frames.py -- SPEC --threads 4 --gpu none

Frames are asked for on standard input, one `12 /path` a line (after a tab, the path of the EXR that is wanted too);
`set 12 96x54 /path` asks for the empty set of a frame at that resolution, `surfaces 12 /folder` for its fluids as they
are drawn. The answers are lines of standard output,
among those that Blender itself writes: first `PICTURES_BY_UV ["object", ...]`, see SceneRenderer, and
`RENDERER_READY version device`, or `RENDERER_FAILED reason`; then for each frame `FRAME_DONE 12 /path` or `FRAME_FAILED
12 reason`. The process ends with its input, so it cannot outlive who started it.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn, TextIO

if __package__ in (None, ""):
    # Run by a Blender executable: the package is not on its path.
    # Last: where the program is installed, that folder holds packages of another Python than Blender's as well.
    sys.path.append(str(Path(__file__).resolve().parents[1]))

import bpy
import numpy as np

from blender_scripts import (
    blend_materials,
    camera,
    exr,
    flattening,
    geometry,
    gpus,
    lights,
    looks,
    png,
    points,
    poses,
    settings,
    tank,
    volumes,
    wetting,
    workbench,
)
from blender_scripts.compatibility import blender_version, require_supported_version
from blender_scripts.documents import read_document
from blender_scripts.errors import RenderFailedError, RenderInputError
from blender_scripts.look_table import LOOK_TABLE
from blender_scripts.optics import REFRACTIVE_INDEX
from blender_scripts.ply import SurfaceMesh, write_mesh
from blender_scripts.shading import LookContext, SmokeBox, tell_apart
from blender_scripts.smoke_looks import glow_of

SPEC_VERSION = 4


class SceneRenderer:
    """A scene built once from a specification; draws one frame after the other.

    Blender has one scene per process, so a second SceneRenderer takes the place of the first.

    Attributes:
        device: what Cycles renders on, e.g. `CPU`; `Workbench` for that engine.
        pictures_by_uv: names of the objects with pictures in their material that lie by texture coordinates.
    """

    _current: SceneRenderer | None = None

    def __init__(self, spec_path: Path, *, threads: int, gpu: int | None = 0) -> None:
        """Build the scene.

        Args:
            spec_path: the RenderSpec document; paths in it are relative to its folder.
            threads: CPU threads to render with.
            gpu: which GPU to render on if the document leaves a choice, counted from 0; None: none.

        Raises:
            RenderInputError: the document, or a mesh that stays the same in all frames, cannot be used.
            RuntimeError: Blender is too old, or the wanted device is missing.
        """
        require_supported_version()
        self._folder = spec_path.resolve().parent
        spec = read_document(spec_path, "render specification", version=SPEC_VERSION)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        SceneRenderer._current = self
        settings.apply_render_settings(spec["render"], fps=spec["fps"], threads=threads)
        self._has_alpha = not lights.shows_set(spec["set"])
        bpy.context.scene.render.film_transparent = self._has_alpha
        self._behind = lights.what_is_behind(spec["set"], self._folder)
        self.device: str = gpus.choose_device(spec["render"]["device"], gpu)
        self._camera = camera.add_camera(spec["camera"])
        self._format, self._passes = spec["render"]["format"], spec["render"]["passes"]
        self._views, self._seed = spec["camera"]["views"], spec["render"]["seed"]
        lights.build_set(spec, self._folder)
        panes = tank.add_tank(spec) if spec["set"]["tank"] else None
        self._of_set = {blender_object.name for blender_object in bpy.data.objects}
        self._sequences: list[tuple[dict[str, Any], Any]] = []
        self._fires: dict[str, volumes.FireLight] = {}
        self._bodies: list[tuple[dict[str, Any], Any]] = []
        self._fluids: list[tuple[dict[str, Any], Any]] = []
        self._touched: list[tuple[dict[str, Any], wetting.Touchable]] = []
        self._vessels: list[_Vessel] = []
        # Workbench sees through nothing.
        is_plain = spec.get("engine") == "workbench"
        self._has_wet = not is_plain and any(_wets(description) for description in spec["objects"])
        self.pictures_by_uv: list[str] = []
        self._floor_z = spec["domain_min"][2]
        self._copies = Counter(filter(None, map(self._shared_by, spec["objects"])))
        self._models: dict[str, _Model] = {}
        drawn = [(description, self._add_object(description, spec)) for description in spec["objects"]]
        # Blender may have chosen another name than the job's.
        casters = {made.name for description, made in drawn if description["material"]["caustics"]}
        if casters:
            settings.cast_caustics(casters, domain_size=_domain_size(spec), domain_middle=_domain_middle(spec))
        if is_plain:
            workbench.apply_workbench_settings(drawn, panes=panes)
            self.device = "Workbench"

    def render(self, frame: int, output_path: Path, master_path: Path | None = None) -> None:
        """Draw one frame into a PNG file of any name, and as an EXR with its passes if one is named.

        The same input gives the same bytes.

        Raises:
            RenderInputError: a file of this frame is missing or unfit.
            RenderFailedError: Blender did not finish.
        """
        self._require_current()
        sheets = []
        for description, blender_object in self._sequences:
            path = self._file(description["file"], frame)
            if description["type"] == "volume_sequence":
                volumes.load_volume(blender_object.data, path)
                if fire := self._fires.get(description["name"]):
                    fire.shine(path)
            elif description["type"] == "point_sequence":
                points.fill_points(blender_object.data, points.read_points(path, description["kind"]))
            else:
                mesh = geometry.read_ply(path)
                geometry.fill_mesh(blender_object.data, mesh)
                if self._is_touched(description):
                    sheets.append(mesh)
        places = self._place_bodies(frame)
        if self._has_wet:
            self._fill_fluids(frame, places, sheets)
        self._place_camera(frame)
        self._draw(frame, output_path, master_path)

    def save_surfaces(self, frame: int, folder: Path) -> None:
        """Write the surfaces of fluids at a frame, with where they touch solids: NAME.ply each.

        Drawn they are beside bodies that know what covers them; these are whole there, for scenes whose do not.

        Raises as `render` does.
        """
        self._require_current()
        sheets = [
            geometry.read_ply(self._file(description["file"], frame))
            for description, _ in self._sequences
            if description["type"] == "mesh_sequence" and self._is_touched(description)
        ]
        opaque = [touched for touched in self._touched if not self._is_covered(touched[0])]
        for description, _, mesh, wetness in self._wetted(frame, self._read_places(frame), sheets, opaque):
            write_mesh(folder / f"{description['name']}.ply", replace(mesh, wet=wetness[:, None]))

    def render_set(self, frame: int, output_path: Path, *, resolution: tuple[int, int]) -> None:
        """Draw what a frame's camera sees without any body: ground, backdrop, tank and their light, in another size.

        Frames that are drawn afterwards are the same as without it. Raises as `render` does.
        """
        self._require_current()
        self._place_camera(frame)
        bodies = [each for each in bpy.data.objects if each.name not in self._of_set and not each.hide_render]
        for body in bodies:
            body.hide_render = True
        try:
            with settings.small_and_clean(resolution):
                self._draw(frame, output_path)
        finally:
            for body in bodies:
                body.hide_render = False

    def _require_current(self) -> None:
        if SceneRenderer._current is not self:
            raise RenderFailedError("another scene was opened in this process; this renderer is closed")

    def _draw(self, frame: int, output_path: Path, master_path: Path | None = None) -> None:
        bpy.context.scene.frame_set(frame)
        outcome = bpy.ops.render.render()
        if "FINISHED" not in outcome:
            raise RenderFailedError(f"Blender ended the render with {sorted(outcome)}")
        # save_render writes to exactly this path; the scene's own output path would expand '#', '{' and add suffixes.
        result = bpy.data.images["Render Result"]
        settings.choose_png(self._format, with_alpha=self._has_alpha)
        result.save_render(str(output_path.resolve()), scene=bpy.context.scene)
        if self._behind is None:
            png.strip_metadata(output_path)
        else:
            flattening.lay_over(output_path, self._behind)
        if master_path is not None:
            settings.choose_exr(with_passes=bool(self._passes), with_alpha=self._has_alpha)
            result.save_render(str(master_path.resolve()), scene=bpy.context.scene)
            exr.strip_metadata(master_path)

    def _is_touched(self, description: dict[str, Any]) -> bool:
        """Whether fluids wet a body. A sheet that bends light has no side that they cover: they keep their surface."""
        return self._has_wet and not (description["type"] == "mesh_sequence" and _refracts(description))

    def _is_covered(self, description: dict[str, Any]) -> bool:
        """Whether it is told of a body where liquids cover it, as it bends light."""
        return self._has_wet and description["type"] in ("mesh", "moving_mesh") and _refracts(description)

    def _file(self, path: str, frame: int) -> Path:
        return self._folder / path.replace("{frame}", f"{frame:06d}")

    def _place_bodies(self, frame: int) -> dict[str, poses.Pose]:
        """Put the bodies that move where they are; returns where, by the name of the object."""
        places = self._read_places(frame)
        for description, blender_object in self._bodies:
            poses.place(blender_object, places[description["name"]], frame=frame)
        return places

    def _read_places(self, frame: int) -> dict[str, poses.Pose]:
        """Where the bodies are that move, by the name of the object."""
        of_file: dict[Path, dict[str, poses.Pose]] = {}
        places = {}
        for description, _ in self._bodies:
            path = self._file(description["poses"], frame)
            if path not in of_file:
                of_file[path] = poses.read_poses(path)
            if description["body"] not in of_file[path]:
                raise RenderInputError(f'the poses {path} have none of "{description["body"]}"')
            places[description["name"]] = of_file[path][description["body"]]
        return places

    def _fill_fluids(self, frame: int, places: dict[str, poses.Pose], sheets: list[SurfaceMesh]) -> None:
        filled = []
        for description, blender_object, mesh, wetness in self._wetted(frame, places, sheets, self._touched):
            geometry.fill_mesh(blender_object.data, mesh, wetness)
            filled.append((description, mesh))
        for vessel in self._vessels:
            vessel.cover(filled, _placed(vessel.touchable, vessel.description, places))

    def _wetted(
        self,
        frame: int,
        places: dict[str, poses.Pose],
        sheets: list[SurfaceMesh],
        bodies: list[tuple[dict[str, Any], wetting.Touchable]],
    ) -> Iterator[tuple[dict[str, Any], Any, SurfaceMesh, np.ndarray]]:
        """Every fluid with its surface, and how far each vertex of that touches the floor, these, or another fluid."""
        solids = [wetting.Touchable.of(sheet, is_closed=False) for sheet in sheets]
        solids += [_placed(body, description, places) for description, body in bodies]
        surfaces = [_read_surface(self._file(description["file"], frame)) for description, _ in self._fluids]
        for (description, blender_object), surface in zip(self._fluids, surfaces, strict=True):
            # Cycles follows light through one surface on its way to the floor, and not through two that are parallel.
            dips, reach = description["material"]["caustics"], description["wets_within"]
            others = [
                wetting.Touchable.of_fluid(other, near=surface, reach=reach)
                for other in surfaces
                if other is not surface
            ]
            touchables = [*solids, *others]
            mesh, wetness = wetting.wetted(
                surface,
                reach=reach,
                floor_z=self._floor_z,
                touchables=touchables,
                dips=dips,
            )
            yield description, blender_object, mesh, wetness

    def _place_camera(self, frame: int) -> None:
        if self._views is None:
            return
        camera.place_camera(self._camera, self._file(self._views, frame), frame=frame)
        # A pattern that stood still in a moving picture would look like dirt on the lens.
        bpy.context.scene.cycles.seed = self.seed_of(frame)

    def seed_of(self, frame: int) -> int:
        """The pattern of samples of a frame that a moving camera sees."""
        return int((self._seed + frame) % 2**31)

    def _shared_by(self, description: dict[str, Any]) -> str | None:
        """What objects have in common that share a mesh and its material; None for those whose mesh is their own."""
        if description["type"] not in ("mesh", "moving_mesh") or self._is_covered(description):
            return None
        common = ("file", "material", "shade_smooth_angle_deg")
        return json.dumps([description[key] for key in common], sort_keys=True)

    def _add_object(self, description: dict[str, Any], spec: dict[str, Any]) -> Any:
        """Add an object; those of a group share mesh and material, and tell their own numbers."""
        shared_by = self._shared_by(description)
        is_shared = shared_by is not None and self._copies[shared_by] > 1
        if not is_shared:
            return self._add_new_object(description, spec, is_shared=False)
        assert shared_by is not None
        model = self._models.get(shared_by)
        if model is None:
            made = self._add_new_object(description, spec, is_shared=True)
            self._models[shared_by] = _Model(description["name"], made.data, self._touchable_of(description))
        else:
            made = geometry.new_object(description["name"], model.mesh)
            self._place_body(description, made)
            if model.touchable is not None:
                self._touched.append((description, model.touchable))
            if model.name in self.pictures_by_uv:
                self.pictures_by_uv.append(description["name"])
        tell_apart(made, description["name"])
        return made

    def _touchable_of(self, description: dict[str, Any]) -> wetting.Touchable | None:
        return next((body for each, body in self._touched if each is description), None)

    def _add_new_object(self, description: dict[str, Any], spec: dict[str, Any], *, is_shared: bool) -> Any:
        name, kind = description["name"], description["type"]
        look = description["material"]["look"]
        at_rest = geometry.read_ply(self._folder / description["file"]) if kind in ("mesh", "moving_mesh") else None
        smoke_box = None
        if kind == "volume_sequence":
            low, high, faces = (tuple(description[key]) for key in ("box_min", "box_max", "open_faces"))
            smoke_box = SmokeBox(low, high, faces, description["ambient_temperature"])
        context = LookContext.of(
            description["material"],
            domain_size=_domain_size(spec),
            pixel_angle=camera.pixel_angle(spec),
            smoke_box=smoke_box,
            surface="sheet" if kind == "mesh_sequence" else "body",
            edges=description.get("edges") if at_rest is None else geometry.edges_of(at_rest),
            name=name,
            wets=_wets(description),
            is_covered=self._is_covered(description),
            is_shared=is_shared,
        )
        if description["material"]["blend"] is None:
            material = looks.new_material(name, look, context)
        else:
            file, inside = blend_materials.split_reference(description["material"]["blend"])
            material = blend_materials.append_material(self._folder / file, inside)
            if blend_materials.has_pictures_by_uv(material):
                self.pictures_by_uv.append(name)
        if at_rest is not None:
            blender_object = geometry.new_mesh_object(name, at_rest)
            self._take_body(description, blender_object, at_rest)
        elif kind == "mesh_sequence":
            blender_object = geometry.new_mesh_object(name, geometry.EMPTY_MESH)
            (self._fluids if self._has_wet and _wets(description) else self._sequences).append(
                (description, blender_object)
            )
        elif kind == "point_sequence":
            is_for_the_eye = look in LOOK_TABLE and LOOK_TABLE[look].lets_light_by
            smallest = looks.SMALLEST_DROP * context.pixel_angle if is_for_the_eye else None
            blender_object = points.new_points_object(name, material, smallest)
            if is_for_the_eye:
                points.let_light_by(blender_object)
            self._sequences.append((description, blender_object))
        else:
            blender_object = volumes.new_volume_object(name)
            self._sequences.append((description, blender_object))
            if look in LOOK_TABLE and LOOK_TABLE[look].glows:
                self._fires[name] = volumes.FireLight(name, glow_of(context))
        blender_object.data.materials.append(material)
        return blender_object

    def _take_body(self, description: dict[str, Any], blender_object: Any, at_rest: SurfaceMesh) -> None:
        """Put a body where it stands, or note that it moves, and what fluids are to know of it."""
        self._place_body(description, blender_object)
        geometry.keep_sharp_edges(blender_object.data, description["shade_smooth_angle_deg"])
        if self._is_touched(description):
            self._touched.append((description, wetting.Touchable.of(at_rest, is_closed=True)))
        if self._is_covered(description):
            self._vessels.append(_Vessel(description, blender_object, at_rest, self._touched[-1][1]))

    def _place_body(self, description: dict[str, Any], blender_object: Any) -> None:
        blender_object.rotation_mode = "QUATERNION"
        if description["type"] == "mesh":
            blender_object.location = description["position"]
            blender_object.rotation_quaternion = description["orientation"]
        else:
            self._bodies.append((description, blender_object))


@dataclass(frozen=True)
class _Model:
    """What the objects of a group share."""

    name: str  # of the first of them
    mesh: Any  # Blender's, with the material
    touchable: wetting.Touchable | None


@dataclass(frozen=True)
class _Vessel:
    """A body that light goes through, and that liquids may cover."""

    description: dict[str, Any]
    blender_object: Any
    at_rest: SurfaceMesh
    touchable: wetting.Touchable

    def cover(self, fluids: Sequence[tuple[dict[str, Any], SurfaceMesh]], placed: wetting.Touchable) -> None:
        """Tell its mesh where fluids cover it, and of which refractive index they are: of two, the one that is more."""
        points = placed.to_world(self.at_rest.vertices.astype(np.float64))
        outwards = geometry.vertex_normals(self.at_rest) @ placed.rotation.T
        covered, index = np.zeros(len(points)), np.zeros(len(points))
        for description, surface in fluids:
            share = wetting.covered(points, outwards, surface=surface, reach=description["wets_within"])
            own = REFRACTIVE_INDEX.get(description["material"]["look"], REFRACTIVE_INDEX["water"]) - 1.0
            # Where none is near yet the index is that of the first: it is not mixed with that of air.
            index = np.where((share > covered) | (index == 0.0), own, index)
            covered = np.maximum(covered, share)
        geometry.set_attribute(self.blender_object.data, geometry.COVERED, covered.astype(np.float32))
        geometry.set_attribute(self.blender_object.data, geometry.COVER_INDEX, index.astype(np.float32))


def _placed(body: wetting.Touchable, description: dict[str, Any], places: dict[str, poses.Pose]) -> wetting.Touchable:
    """A body where it is in a frame."""
    pose = places.get(description["name"])
    place = (description["position"], description["orientation"]) if pose is None else pose.after(0.0)
    return body.placed(*place)


def _refracts(description: dict[str, Any]) -> bool:
    look = LOOK_TABLE.get(description["material"]["look"])
    return look is not None and look.refracts


def _read_surface(path: Path) -> SurfaceMesh:
    """A fluid's surface.

    Raises:
        RenderInputError: it cannot be read, or has no normals.
    """
    surface = geometry.read_ply(path)
    if surface.normals is None:
        raise RenderInputError(f"the surface {path} has no normals (nx, ny, nz)")
    return surface


def _wets(description: dict[str, Any]) -> bool:
    """Whether an object is a fluid, which tells where it touches solids."""
    return description.get("wets_within") is not None


def _domain_middle(spec: dict[str, Any]) -> tuple[float, ...]:
    return tuple(0.5 * (low + high) for low, high in zip(spec["domain_min"], spec["domain_max"], strict=True))


def _domain_size(spec: dict[str, Any]) -> float:
    return sum((high - low) ** 2 for low, high in zip(spec["domain_min"], spec["domain_max"], strict=True)) ** 0.5


def _parse_arguments(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="render_frames.py", description="Draw frames of a RenderSpec.")
    parser.add_argument("spec", type=Path, help="the RenderSpec document")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="CPU threads (default: all)")
    parser.add_argument("--gpu", default="0", help="which GPU, counted from 0, or none (default: 0)")
    return parser.parse_args(arguments)


def _report(line: str) -> None:
    sys.stdout.write(line.replace("\n", " ") + "\n")
    sys.stdout.flush()


def _follow(stream: TextIO, requests: queue.SimpleQueue[str | None]) -> None:
    """Pass on lines, and end the process with its input, even in the middle of a frame: nobody waits for it."""
    for line in stream:
        requests.put(line)
    os._exit(0)


def _serve(renderer: SceneRenderer) -> NoReturn:
    requests: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    threading.Thread(target=_follow, args=(sys.stdin, requests), daemon=True).start()
    _report(f"PICTURES_BY_UV {json.dumps(renderer.pictures_by_uv)}")
    _report(f"RENDERER_READY {blender_version()} {renderer.device}")
    while True:
        _answer(renderer, requests.get().rstrip("\n"))


def _answer(renderer: SceneRenderer, request: str) -> None:
    """Draw what is asked for, and report the result."""
    empty_set, surfaces = request.startswith("set "), request.startswith("surfaces ")
    if surfaces:
        _, frame, path = request.split(" ", 2)
    elif empty_set:
        _, frame, size, path = request.split(" ", 3)
    else:
        frame, _, paths = request.partition(" ")
        path, _, master_path = paths.partition("\t")
    try:
        if surfaces:
            renderer.save_surfaces(int(frame), Path(path))
        elif empty_set:
            width, height = map(int, size.split("x"))
            renderer.render_set(int(frame), Path(path), resolution=(width, height))
        else:
            renderer.render(int(frame), Path(path), Path(master_path) if master_path else None)
    except (RenderInputError, RenderFailedError, OSError, RuntimeError, ValueError) as error:
        _report(f"FRAME_FAILED {frame} {error}")
    else:
        _report(f"FRAME_DONE {frame} {path}")


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit code of what cannot begin."""
    options = _parse_arguments(arguments)
    gpu = None if options.gpu == "none" else int(options.gpu)
    try:
        renderer = SceneRenderer(options.spec, threads=options.threads, gpu=gpu)
    except (RenderInputError, RuntimeError) as error:
        _report(f"RENDERER_FAILED {error}")
        return 1
    return _serve(renderer)


if __name__ == "__main__":
    # A Blender executable leaves its own arguments before the `--`.
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
