"""Checks of a valid job as a whole: names, materials, times, pictures; then its bodies, kind by kind."""

from math import log2
from pathlib import Path

from blender_scripts.look_table import LOOK_TABLE, MATERIAL_KEYS, looks_for
from pipeline.job.checks.camera import check_camera
from pipeline.job.checks.optical_depth import check_optical_depths
from pipeline.job.checks.set import check_blend, check_keys_beside_blend, check_set
from pipeline.job.magnitudes import check_magnitudes
from pipeline.kinds.base import Kind
from pipeline.kinds.checks.forces import check_forces
from pipeline.kinds.checks.joints import check_joints
from pipeline.kinds.checks.memory_budget import MemoryBudget, free_bytes, memory_budget
from pipeline.kinds.checks.shapes import build_solids, in_scale
from pipeline.kinds.rigid import RIGID
from pipeline.kinds.table import KINDS, bodies, described_material, is_meant, placements
from pipeline.model.boxes import simulated_regions
from pipeline.model.groups import of_tables, written_place
from pipeline.model.job import Job
from pipeline.model.looks import BODY, WHITEWATER
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path, quoted_list, unknown_name
from render.parameters import HIGHEST_FPS, MaterialParameters

MANY_FRAMES = 100_000
GLOWING_K = 900.0
"""From here on the glow of smoke shows beside other light; by day it takes 1200 K and more [K]."""
BURNING_SUN = 20.0
"""Irradiance, times that of the exposure, from which a grey ground is nearly white in a picture [W/m²]."""


def check_description(job: Job, memory_bytes: int | None = None) -> Findings:
    """Look at all that a job describes, which `read_job` has returned, with absolute mesh paths.

    Reads the mesh files and fills the fluid's blocks, so it takes a second or two for a large scene. The simulation may
    use `memory_bytes`; this machine's if omitted.
    """
    findings = Findings()
    _check_bodies(job, findings)
    check_joints(job, findings)
    check_forces(job, findings)
    _check_whitewater(job, findings)
    _check_materials(job, findings)
    _check_dye(job, findings)
    _check_time(job, findings)
    _check_pictures(job, findings)
    check_set(job, findings)
    if check_magnitudes(job, findings):
        solids = in_scale(
            build_solids(placements(job), findings, room_bytes=free_bytes()), simulated_regions(job), findings
        )
        budget = memory_budget(job) if memory_bytes is None else MemoryBudget(memory_bytes, "this machine")
        check_camera(job, solids, findings)
        for kind in KINDS.values():
            findings.elements[kind.name] = kind.check(job, solids, budget, findings) if kind.bodies(job) else 0
        if not findings.errors:
            check_optical_depths(job, findings)
    for kind_of_problem in (findings.errors, findings.warnings, findings.facts):
        kind_of_problem[:] = of_tables(job, kind_of_problem)
    return findings


def _check_bodies(job: Job, findings: Findings) -> None:
    found = list(bodies(job))
    tables = [f"[[{name}]]" for name in KINDS]
    if not found:
        findings.error((), f"has no body; add {', '.join(tables[:-1])} or {tables[-1]}")
    elif not (job.moving_bodies or job.placed_camera.moves or any(kind is not RIGID for _, kind, _ in found)):
        others = [table for table in tables if table != f"[[{RIGID.name}]]"]
        findings.warn((), f"has no {', '.join(others[:-1])} or {others[-1]}, so nothing will move")
    # Names become file names, and some file systems do not tell upper from lower case.
    taken: dict[str, KeyPath] = {}
    told = set()
    for path, kind, body in found:
        other_kind = KINDS.get(body.name)
        if kind.shares_solver is None and other_kind is not None and other_kind.has_shared_solver(job):
            findings.error(
                (*path, "name"), f'"{body.name}" is what the solver of all [[{body.name}]] is called; take another'
            )
        table = written_place(job, path)
        for name in dict.fromkeys((body.name, getattr(body, "whole", None), getattr(body, "group", None))):
            if name is None or (other := taken.setdefault(name.casefold(), table)) == table or (name, table) in told:
                continue
            told.add((name, table))
            says = f'"{name}" is' if name == body.name else f'is of "{name}", a name that is'
            findings.error((*path, "name"), f"{says} taken by {format_path(other)}; names are unique in a job")


def _check_whitewater(job: Job, findings: Findings) -> None:
    fluids = [fluid.name for fluid in job.fluid]
    for name in job.whitewater:
        if name not in fluids:
            findings.error(("whitewater", name), unknown_name(name, fluids, "fluid", none="; add [[fluid]]"))


def _check_materials(job: Job, findings: Findings) -> None:
    kinds = {body.name: kind for _, kind, body in bodies(job)}
    kinds |= dict.fromkeys(job.groups.values(), RIGID)
    for _, kind, body in bodies(job):
        unused = {BODY} if body.name in job.whitewater else {BODY, *WHITEWATER}
        names = dict.fromkeys((body.name, job.groups.get(body.name, body.name)))
        kinds |= {f"{name}.{part}": kind for name in names for part in kind.material(body) if part not in unused}
    for written, said in job.material.items():
        path: KeyPath = ("material", written)
        meant = [name for name in kinds if is_meant(written, name)]
        if said.blend is not None:
            check_blend(said, path, kinds[meant[0]] if meant else None, findings)
        if not meant:
            findings.error(path, unknown_name(written, kinds, "body", plural="bodies"))
        for name in meant:
            owner, _, part = name.partition(".")
            if owner in job.groups and ".".join(filter(None, (job.groups[owner], part))) in meant:
                continue  # what is said of its group is said of it
            material = described_material(job, owner, part or BODY)
            if said.blend is None and material.blend is not None:
                check_keys_beside_blend(said, path, findings)
            elif material.look is not None:
                _check_look(job, material, path, name, kinds[name], findings=findings)


def _check_dye(job: Job, findings: Findings) -> None:
    """Warn of dye that no picture shows, and of the colour of a dye that is not there."""
    dyed = {body.name for mixing in (job.fluid, job.soft) for body in mixing if body.has_dye}
    fluids = {fluid.name for fluid in job.fluid}
    reached = dyed | (fluids if dyed & fluids else set())  # it goes from one fluid of a tank into the others
    rows = {name: LOOK_TABLE[name] for name in looks_for("fluid")}
    showing = [name for name, row in rows.items() if "dye_color" in row.keys and not row.lets_light_by]
    for path, _, body in bodies(job):
        material = described_material(job, body.name)
        if body.name not in dyed or material.look is None:
            continue
        if material.look not in showing:
            findings.warn(
                path,
                f'has dye, and its look "{material.look}" does not show it; use {quoted_list(showing)}, or read it '
                "from the frames",
            )
        elif material.dye_color is None:
            findings.warn(path, f"has dye, and no picture shows it; add dye_color to [material.{body.name}]")
    for written, said in job.material.items():
        meant = {body.name: path[0] for path, _, body in bodies(job) if is_meant(written, body.name)}
        if said.dye_color is not None and meant and not reached & set(meant):
            name, kind = next(iter(meant.items()))
            remedy = f"give a [[{kind}.block]] or [[{kind}.emitter]] of it a dye"
            findings.warn(
                ("material", written, "dye_color"),
                f'has no effect, as "{name}" has no dye; {remedy if kind in ("fluid", "soft") else "remove it"}',
            )


def _check_look(
    job: Job, material: MaterialParameters, path: KeyPath, name: str, kind: Kind, *, findings: Findings
) -> None:
    assert material.look is not None
    _check_wearer(material.look, path, kind, name, findings)
    _check_keys(material, path, findings)
    if LOOK_TABLE[material.look].glows:
        _check_glow(job, path, name, material.look, findings)


def _check_wearer(look: str, table: KeyPath, kind: Kind, name: str, findings: Findings) -> None:
    """Note a look that a kind of body cannot have, or whose texture has nothing there to hang on."""
    path, row = (*table, "look"), LOOK_TABLE[look]
    if kind.wears not in row.bodies and kind.wears == "smoke":
        findings.error(path, f'{kind.name} can only look like {quoted_list(looks_for(kind.wears))}, got "{look}"')
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


def _check_glow(job: Job, table: KeyPath, name: str, look: str, findings: Findings) -> None:
    hottest = [smoke.ambient_temperature + smoke.hottest_excess for smoke in job.smoke if smoke.name == name]
    if hottest and max(hottest) < GLOWING_K:
        findings.warn(
            (*table, "look"),
            f'is "{look}", but its hottest gas has {max(hottest):g} K, and nothing glows below some '
            f"{GLOWING_K:g} K; flames have 1300 K and more",
        )


def _check_time(job: Job, findings: Findings) -> None:
    if job.duration is not None and job.duration * job.fps < 0.5:
        findings.warn(("duration",), f"{job.duration:g} s are less than a frame at {job.fps} fps; the film has one")
    if job.frame_count > MANY_FRAMES:
        findings.warn(
            ("frames",) if job.frames else ("duration",),
            f"{job.frame_count} frames are {job.film_s / 60:.0f} minutes of film; is the number meant?",
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
        if key.time_s > job.film_s:
            findings.warn(
                ("camera", "keyframe", number, "time_s"),
                f"is after the film's end at {job.film_s:g} s; the camera does not get there",
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
