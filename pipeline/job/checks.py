"""What a valid job may still have wrong: names, looks, pictures and the camera. Its geometry is in `scene_checks`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import log2
from pathlib import Path

from pipeline.errors import JobFileError
from pipeline.job.loading import LoadedJob, read_job
from pipeline.job.looks import (
    BODY,
    GLOWING_K,
    REFRACTING_LOOKS,
    ROUGH_LOOKS,
    TEXTURED_LOOKS,
    VOLUME_LOOKS,
    WHITEWATER,
    WOVEN_LOOKS,
    parts_of,
)
from pipeline.job.magnitudes import check_magnitudes
from pipeline.job.models import Job
from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings, format_path, suggestion
from pipeline.job.scene_checks import check_scene
from pipeline.job.stage_checks import check_blend, check_keys_beside_blend, check_stage
from pipeline.stages import STAGES
from pipeline.stages.movie import MovieStage
from render.parameters import HIGHEST_FPS, MaterialParameters

MANY_FRAMES = 100_000
BURNING_SUN = 20.0
"""Irradiance, times that of the exposure, from which a grey ground is nearly white in a picture [W/m²]."""


def check_job(job: Job, *, memory_bytes: int | None = None) -> Findings:
    """Look at the whole job: everything that can be known before any work starts.

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
    check_stage(job, findings)
    _check_limits(job, findings)
    if check_magnitudes(job, findings):
        check_scene(job, findings, memory_bytes)
    return findings


def named_bodies(job: Job) -> Iterator[tuple[KeyPath, str, str]]:
    """Path, kind and name of every body."""
    for kind in ("rigid", "fluid", "smoke", "cloth"):
        for index, body in enumerate(getattr(job, kind)):
            yield (kind, index), kind, body.name


def _check_bodies(job: Job, findings: Findings) -> None:
    if not job.body_names:
        findings.error((), "has no body; add [[fluid]], [[smoke]], [[cloth]] or [[rigid]]")
    elif not (job.fluid or job.smoke or job.cloth or job.moving_bodies or job.placed_camera.moves):
        findings.warn((), "has neither fluid nor smoke nor cloth, so nothing will move")
    for kind, solver in (("rigid", "moving bodies"), ("cloth", "cloths")):
        moves = job.cloth if kind == "cloth" else [body for body in job.rigid if body.kind != "static"]
        for path, of_kind, name in named_bodies(job):
            if moves and of_kind in ("fluid", "smoke") and name == kind:
                findings.error((*path, "name"), f'"{kind}" is what all {solver} are called together; take another')
    # Names become file names, and some file systems do not tell upper from lower case.
    taken: dict[str, KeyPath] = {}
    for path, _, name in named_bodies(job):
        if other := taken.get(name.casefold()):
            findings.error((*path, "name"), f'"{name}" is taken by {format_path(other)}; names are unique in a job')
        taken.setdefault(name.casefold(), path)


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
    kinds = {name: kind for _, kind, name in named_bodies(job)}
    for body in job.rigid:
        kinds |= {f"{body.name}.{part}": "rigid" for part in parts_of(body.shape.type) if part != BODY}
    kinds |= {f"{fluid}.{part}": "fluid" for fluid in job.whitewater for part in WHITEWATER}
    for name, said in job.material.items():
        path: KeyPath = ("material", name)
        owner, _, part = name.partition(".")
        material = job.described_material(owner, part or BODY) if name in kinds else said
        if said.blend is not None:
            check_blend(said, path, kinds.get(name), findings)
        elif material.blend is not None:
            check_keys_beside_blend(said, path, findings)
        if name not in kinds:
            hint = suggestion(name, kinds) or (f"; bodies are {', '.join(kinds)}" if kinds else "")
            findings.error(path, f'no body is named "{name}"{hint}')
        elif kinds[name] == "smoke" and material.look not in VOLUME_LOOKS and material.look is not None:
            findings.error((*path, "look"), f'smoke can only look like "smoke" or "fire", got "{material.look}"')
        elif kinds[name] != "smoke" and material.look in VOLUME_LOOKS:
            findings.error(
                (*path, "look"), f'"{material.look}" is a look for [[smoke]]; "{name}" is in [[{kinds[name]}]]'
            )
        elif kinds[name] != "cloth" and material.look in WOVEN_LOOKS:
            findings.error(
                (*path, "look"), f'"{material.look}" is a look for [[cloth]]; "{name}" is in [[{kinds[name]}]]'
            )
        elif material.look in TEXTURED_LOOKS and kinds[name] not in TEXTURED_LOOKS[material.look]:
            findings.warn(
                (*path, "look"), f'is "{material.look}", whose texture hangs on nothing in [[{kinds[name]}]]: it swims'
            )
        if material.look is not None:
            _check_keys(material, path, findings)
        if material.look == "fire":
            _check_glow(job, name, findings)


def _check_keys(material: MaterialParameters, path: KeyPath, findings: Findings) -> None:
    if material.thread_spacing is not None and material.look not in WOVEN_LOOKS:
        findings.warn((*path, "thread_spacing"), f'has no effect on the look "{material.look}"')
    if material.caustics and material.look not in REFRACTING_LOOKS:
        findings.warn((*path, "caustics"), f'has no effect on the look "{material.look}"')
    for key, looks in (
        ("roughness", ROUGH_LOOKS),
        ("density", (*VOLUME_LOOKS, "water", "honey", "milk")),
        ("anisotropy", VOLUME_LOOKS),
        ("edge_fade", VOLUME_LOOKS),
        ("emission", ("fire",)),
        ("flame_temperature", ("fire",)),
    ):
        if getattr(material, key) is not None and material.look not in looks:
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
    for obstacle in MovieStage().obstacles(job):
        findings.error(("movie", "codec"), obstacle)
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
                f"{job.render.exposure:g}; the sun of the stage outdoor has 5.5",
            )


def _check_limits(job: Job, findings: Findings) -> None:
    stages = [stage.name for stage in STAGES]
    for name, limits in job.limits.items():
        if name not in stages:
            hint = suggestion(name, stages) or f"; stages are {', '.join(stages)}"
            findings.error(("limits", name), f'no stage is named "{name}"{hint}')
        if limits.timeout_s is not None and limits.timeout_s < limits.stall_s and "stall_s" in limits.model_fields_set:
            findings.warn(
                ("limits", name, "stall_s"),
                f"has no effect: a task is ended after timeout_s = {limits.timeout_s:g} s in any case",
            )


def load_checked_job(
    path: Path | str, overrides: Sequence[str] = (), *, preview: bool = False
) -> tuple[LoadedJob, Findings]:
    """Read a job file as `read_job` does, and look at the whole job; its warnings are in place.

    Raises:
        JobFileError: carries every problem found.
    """
    loaded = read_job(path, overrides, preview=preview)
    findings = check_job(loaded.job)
    if findings.errors:
        raise JobFileError(loaded.source.describe_all(findings.errors))
    return replace(loaded, warnings=tuple(loaded.source.describe_all(findings.warnings))), findings
