"""Checks of a valid job as a whole: names, materials, times, pictures; then its bodies, kind by kind."""

from __future__ import annotations

from math import log2
from pathlib import Path

from blender_scripts.look_table import LOOK_TABLE, MATERIAL_KEYS, looks_for
from pipeline.job.checks.camera import check_camera
from pipeline.job.checks.set import check_blend, check_keys_beside_blend, check_set
from pipeline.job.magnitudes import check_magnitudes
from pipeline.kinds.base import Kind
from pipeline.kinds.checks.memory_budget import MemoryBudget, memory_budget
from pipeline.kinds.rigid import RIGID
from pipeline.kinds.solids import build_solids
from pipeline.kinds.table import KINDS, bodies, described_material
from pipeline.model.job import Job
from pipeline.model.looks import (
    BODY,
    GLOWING_K,
    WHITEWATER,
    parts_of,
)
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path, suggestion
from render.parameters import HIGHEST_FPS, MaterialParameters

MANY_FRAMES = 100_000
BURNING_SUN = 20.0
"""Irradiance, times that of the exposure, from which a grey ground is nearly white in a picture [W/m²]."""


def check_description(job: Job, memory_bytes: int | None = None) -> Findings:
    """Look at all that the job file describes.

    Reads the mesh files and fills the fluid's blocks, so it takes a second or two for a large scene.

    Args:
        job: a job as `read_job` returns it, with absolute mesh paths.
        memory_bytes: what the simulation may use; this machine's if omitted.
    """
    findings = Findings()
    _check_bodies(job, findings)
    _check_wind(job, findings)
    _check_whitewater(job, findings)
    _check_materials(job, findings)
    _check_faces(job, findings)
    _check_time(job, findings)
    _check_pictures(job, findings)
    check_set(job, findings)
    if check_magnitudes(job, findings):
        _check_scene(job, findings, memory_bytes)
    return findings


def _check_scene(job: Job, findings: Findings, memory_bytes: int | None) -> None:
    """Shapes, places and sizes, kind by kind, and how large it all is."""
    solids = build_solids(job, findings)
    budget = memory_budget(job) if memory_bytes is None else MemoryBudget(memory_bytes, "this machine")
    check_camera(job, solids, findings)
    for kind in KINDS.values():
        findings.elements[kind.name] = kind.check(job, solids, budget, findings)


def _check_bodies(job: Job, findings: Findings) -> None:
    found = list(bodies(job))
    if not found:
        tables = [f"[[{name}]]" for name in KINDS]
        findings.error((), f"has no body; add {', '.join(tables[:-1])} or {tables[-1]}")
    elif not (job.moving_bodies or job.placed_camera.moves or any(kind is not RIGID for _, kind, _ in found)):
        others = [name for name in KINDS if name != RIGID.name]
        findings.warn((), f"has neither {' nor '.join(others)}, so nothing will move")
    for kind, solver in (("rigid", "moving bodies"), ("cloth", "cloths")):
        moves = job.cloth if kind == "cloth" else [body for body in job.rigid if body.kind != "static"]
        for path, of_kind, body in found:
            if moves and of_kind.name in ("fluid", "smoke") and body.name == kind:
                findings.error((*path, "name"), f'"{kind}" is what all {solver} are called together; take another')
    # Names become file names, and some file systems do not tell upper from lower case.
    taken: dict[str, KeyPath] = {}
    for path, _, body in found:
        if other := taken.get(body.name.casefold()):
            findings.error(
                (*path, "name"), f'"{body.name}" is taken by {format_path(other)}; names are unique in a job'
            )
        taken.setdefault(body.name.casefold(), path)


def _check_wind(job: Job, findings: Findings) -> None:
    for index, cloth in enumerate(job.cloth):
        for smoke in job.smoke:
            lower, upper = smoke.corners(job.domain)
            starts_inside = all(a <= x <= b for a, x, b in zip(lower, cloth.position, upper, strict=True))
            if any(cloth.wind) and cloth.wind != smoke.wind and starts_inside:
                findings.warn(
                    ("cloth", index, "wind"),
                    f'does not blow in the box of smoke "{smoke.name}", where the cloth starts: the air of the smoke '
                    "moves it there; give the smoke that wind, or another box",
                )


def _check_whitewater(job: Job, findings: Findings) -> None:
    fluids = [fluid.name for fluid in job.fluid]
    for name in job.whitewater:
        if name not in fluids:
            hint = suggestion(name, fluids) or (f"; fluids are {', '.join(fluids)}" if fluids else "; add [[fluid]]")
            findings.error(("whitewater", name), f'no fluid is named "{name}"{hint}')


def _check_materials(job: Job, findings: Findings) -> None:
    kinds = {body.name: kind for _, kind, body in bodies(job)}
    for body in job.rigid:
        kinds |= {f"{body.name}.{part}": KINDS["rigid"] for part in parts_of(body.shape.type) if part != BODY}
    kinds |= {f"{fluid}.{part}": KINDS["fluid"] for fluid in job.whitewater for part in WHITEWATER}
    for name, said in job.material.items():
        path: KeyPath = ("material", name)
        owner, _, part = name.partition(".")
        material = described_material(job, owner, part or BODY) if name in kinds else said
        if said.blend is not None:
            check_blend(said, path, kinds[name].name if name in kinds else None, findings)
        elif material.blend is not None:
            check_keys_beside_blend(said, path, findings)
        if name not in kinds:
            hint = suggestion(name, kinds) or (f"; bodies are {', '.join(kinds)}" if kinds else "")
            findings.error(path, f'no body is named "{name}"{hint}')
        elif material.look is not None:
            _check_wearer(material.look, kinds[name], name, findings)
        if material.look is not None:
            _check_keys(material, path, findings)
            if LOOK_TABLE[material.look].glows:
                _check_glow(job, name, findings)


def _check_wearer(look: str, kind: Kind, name: str, findings: Findings) -> None:
    """Note a look that a kind of body cannot have, or whose texture has nothing there to hang on."""
    path, row = ("material", name, "look"), LOOK_TABLE[look]
    if kind.wears not in row.bodies and kind.wears == "smoke":
        fitting = " or ".join(f'"{each}"' for each in looks_for(kind.wears))
        findings.error(path, f'smoke can only look like {fitting}, got "{look}"')
    elif kind.wears not in row.bodies:
        findings.error(path, f'"{look}" is a look for [[{row.bodies[0]}]]; "{name}" is in [[{kind.name}]]')
    elif kind.wears in row.swims_on:
        findings.warn(path, f'is "{look}", whose texture hangs on nothing in [[{kind.name}]]: it swims')


def _check_keys(material: MaterialParameters, path: KeyPath, findings: Findings) -> None:
    assert material.look is not None
    heeded = LOOK_TABLE[material.look].keys
    for key in MATERIAL_KEYS:
        value = getattr(material, key)
        if value is not None and value is not False and key not in heeded:
            findings.warn((*path, key), f'has no effect on the look "{material.look}"')


def _check_glow(job: Job, name: str, findings: Findings) -> None:
    hottest = [source.temperature for smoke in job.smoke if smoke.name == name for source in smoke.source]
    if hottest and max(hottest) < GLOWING_K:
        findings.warn(
            ("material", name, "look"),
            f'is "fire", but the hottest source has {max(hottest):g} K, and nothing glows below some {GLOWING_K:g} K; '
            "flames have 1300 K and more",
        )


def _check_faces(job: Job, findings: Findings) -> None:
    lists: list[tuple[KeyPath, tuple[str, ...]]] = [(("domain", "open_faces"), job.domain.open_faces)]
    lists += [(("smoke", index, "open_faces"), smoke.open_faces) for index, smoke in enumerate(job.smoke)]
    for path, faces in lists:
        for face in dict.fromkeys(face for face in faces if faces.count(face) > 1):
            findings.error(path, f'names "{face}" more than once')


def _check_time(job: Job, findings: Findings) -> None:
    length = job.frame_count / job.fps
    if job.duration is not None and job.duration * job.fps < 0.5:
        findings.warn(("duration",), f"{job.duration:g} s are less than a frame at {job.fps} fps; the film has one")
    if job.frame_count > MANY_FRAMES:
        findings.warn(
            ("frames",) if job.frames else ("duration",),
            f"{job.frame_count} frames are {length / 60:.0f} minutes of film; is the number meant?",
        )
    for index, smoke in enumerate(job.smoke):
        for number, source in enumerate(smoke.source):
            if source.start_s >= length:
                findings.warn(
                    ("smoke", index, "source", number, "start_s"),
                    f"starts at {source.start_s:g} s, after the film's end at {length:g} s",
                )


def _check_pictures(job: Job, findings: Findings) -> None:
    width, height = job.render.resolution
    if width % 2 or height % 2:
        even = f"{width + width % 2} x {height + height % 2}"
        findings.error(
            ("render", "resolution"), f"must be even numbers, as video needs them, got {width} x {height}; use {even}"
        )
    rate, highest = job.movie.playback_fps or job.fps, HIGHEST_FPS.get(job.movie.codec)
    if highest is not None and rate > highest:
        findings.error(
            ("movie", "codec"),
            f'"{job.movie.codec}" has at most {highest:g} frames a second, got {rate:g}; set movie.playback_fps, or '
            "another codec",
        )
    if job.render.blender is not None and not Path(job.render.blender).is_file():
        findings.error(("render", "blender"), f"no such file: {job.render.blender}; omit it to use the bpy module")
    camera = job.placed_camera
    if camera.position is not None and camera.position == camera.look_at:
        findings.error(("camera", "look_at"), "is where the camera stands; it must be somewhere else")
    for number, key in enumerate(camera.keyframe):
        if key.position == (key.look_at or camera.look_at or job.domain.middle):
            findings.error(
                ("camera", "keyframe", number, "look_at"), "is where the camera is; it must be somewhere else"
            )
        if key.time_s > job.frame_count / job.fps:
            findings.warn(
                ("camera", "keyframe", number, "time_s"),
                f"is after the film's end at {job.frame_count / job.fps:g} s; the camera does not get there",
            )
    for index, light in enumerate(job.light):
        if light.position == light.look_at and light.type != "point":
            findings.error(("light", index, "look_at"), "is where the light stands; it must be somewhere else")
        if light.type == "sun" and log2(light.power_that_counts) + job.render.exposure > log2(BURNING_SUN):
            findings.warn(
                ("light", index, "power"),
                f"is {light.power_that_counts:g} W/m² for a sun, which burns the picture white at exposure "
                f"{job.render.exposure:g}; the sun of the set outdoor has 5.5",
            )
