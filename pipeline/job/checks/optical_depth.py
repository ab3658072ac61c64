"""How much of the light gets through liquids and smoke, by their looks and sizes: whether these will be seen."""

from typing import Any

from blender_scripts.optics import INSIDES, dye_per_metre, per_metre, usual_density
from pipeline.kinds.base import Kind
from pipeline.kinds.table import bodies, is_meant, material_of
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, Problem
from render.parameters import MaterialParameters

LEAST_DEPTH = 0.1
"""Optical depth below which a tint or a smoke is not seen: a tenth of the light is changed."""
TAR_DEPTH, WALL_DEPTH = 8.0, 30.0
"""From the first on no colour gets through what absorbs; from the second on smoke has an edge as a solid has."""


def check_optical_depths(job: Job, findings: Findings) -> None:
    """Note the optical depth of each body that light goes into, and warn where it will not be seen, or is black."""
    for path, kind, body in bodies(job):
        material = material_of(job, body.name)
        if material.look in INSIDES:
            _check(job, path, kind, body, material, findings=findings)


def _check(job: Job, path: KeyPath, kind: Kind, body: Any, material: MaterialParameters, *, findings: Findings) -> None:
    assert material.look is not None
    size, is_smoke = kind.look_size(job, body), kind.wears == "smoke"
    usual = usual_density(material.look, size, material.color)
    density = usual if material.density is None else material.density
    depths = [size * each for each in per_metre(material.look, density, material.color)]
    is_grey = max(depths) == min(depths)
    written = f"{depths[0]:.2g}" if is_grey else " / ".join(f"{each:.2g}" for each in depths) + " (red / green / blue)"
    across = "across its source" if is_smoke else f"across {size:.2g} m"
    findings.facts.append(
        Problem(path, f'"{body.name}" as {material.look}: optical depth {written} {across}, density {density:.3g}')
    )
    if material.density is None:
        return  # the job's own colour may be meant to be clear
    if not is_smoke and material.dye_color is not None and not INSIDES[material.look].scatters:
        dye = dye_per_metre(material.look, density, material.color, material.dye_color)
        if size * max(dye) >= LEAST_DEPTH:
            return  # it is clear where there is no dye, and the dye is seen
    if max(depths) < LEAST_DEPTH:
        outcome = "the smoke is not seen" if is_smoke else "the tint is not seen"
    elif is_smoke and min(depths) > WALL_DEPTH:
        outcome = "it looks solid"
    elif not INSIDES[material.look].scatters and min(depths) > TAR_DEPTH:
        outcome = "it is as black as tar"
    else:
        return
    findings.warn(
        (*_table_of(job, body.name), "density"),
        f'{density:g} gives "{body.name}" an optical depth of {max(depths):.2g}: {outcome}; omit it, which is '
        f"{usual:.2g} here",
    )


def _table_of(job: Job, name: str) -> KeyPath:
    """The table of materials that gives a body its density."""
    names = name, job.groups.get(name, name)
    tables = [
        written
        for written, said in job.material.items()
        if said.density is not None and (written in names or is_meant(written, name))
    ]
    return ("material", next((each for each in names if each in tables), tables[-1]))
