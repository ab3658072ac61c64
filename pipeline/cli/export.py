"""The command that hands a job over: to other programs, or to another farm manager."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base import wording
from pipeline.base.layout import JobLayout
from pipeline.base.wording import print_warnings
from pipeline.cli.arguments import (
    job_options,
    output_option,
    parse_frames,
    queue_options,
    submission_folder,
)
from pipeline.queue.submitting import QueueOptions
from pipeline.queue.submitting import submit as submit_to_queue

if TYPE_CHECKING:
    from pipeline.stages.export import ExportStage

FORMATS = ("usd", "blend", "abc", "vtk", "gltf")
"""As the stages have them, which are too heavy to be imported for `--help`."""
OPENJD = "openjd"


@click.command()
@job_options
@click.option("--to", "wanted", type=click.Choice([*FORMATS, OPENJD]), required=True, help="The format; see below.")
@click.option(
    "--frames", metavar="RANGES", help="Only these frames: 7 or 0-29,60-89, or every fourth of 0-99x4; all if omitted."
)
@click.option(
    "-o",
    "--output",
    "target",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Copy the export into this folder, complete in itself.",
)
@click.option(
    "--python",
    help="With openjd: the interpreter with this program on the farm's machines; the present one if omitted.",
)
@output_option
@queue_options
def export(
    *,
    job_file: Path,
    overrides: tuple[str, ...],
    preview: bool,
    wanted: str,
    frames: str | None,
    target: Path | None,
    python: str | None,
    output: Path,
    options: QueueOptions,
) -> None:
    """Write a job's frames as files of other programs.

    What is missing of the frames is simulated first; pictures are not drawn. Each frame is a task as of any stage:
    stopped and called again it continues, and only what changed is written again. The file to open lies in the job's
    folder, and shows the files beside it by relative paths; -o makes a copy that can be given away.

    \b
    usd     Houdini, Maya, Omniverse and others: meshes, points, volumes, camera, preview materials
    blend   Blender 4.5 LTS and later: the whole lit scene, which renders the film's frames
    abc     Alembic, one file: bodies, surfaces, cloths, drops, whitewater and camera; no smoke, no materials
    vtk     ParaView: one time series of particles, surfaces, drops, cloths, bodies and smoke, with names and units
    gltf    the web, one .glb: bodies, surfaces, cloths and camera; no smoke, drops or whitewater, 100 MB at most
    openjd  a farm manager: an Open Job Description template of the whole job, which runs it there

    \b
    pipeline export my-film --to usd
    pipeline export my-film --to blend --frames 10-40 -o ~/for-anna
    pipeline export my-film --to gltf --frames 0-239x4
    pipeline export dam.toml --to vtk --set fluid.water.particle_radius=0.01
    pipeline export dam.toml --to openjd --farm /shared/renders
    """
    if wanted == OPENJD:
        if frames is not None or target is not None:
            raise click.UsageError("openjd describes the whole job, in its folder; leave --frames and -o out")
        _write_openjd(job_file, overrides, preview=preview, output=output, python=python or sys.executable)
        return
    if python is not None:
        raise click.UsageError("--python goes with --to openjd")
    chosen = "" if frames is None else f":{frames}"
    if frames is not None:
        parse_frames(frames)
    if target is not None and any(each.exists() and not each.is_dir() for each in (target, *target.parents)):
        raise click.BadParameter(f"{target} is not a folder, or lies in what is none", param_hint="-o")
    _export(
        job_file,
        overrides,
        preview=preview,
        end=f"{_stage(wanted).name}{chosen}",
        output=output,
        options=options,
        target=target,
    )


def _export(
    job_file: Path,
    overrides: tuple[str, ...],
    *,
    preview: bool,
    end: str,
    output: Path,
    options: QueueOptions,
    target: Path | None,
) -> None:
    from pipeline.job.loading import load_job
    from pipeline.queue.job_queue import Desired, JobQueue
    from pipeline.run.checked_job import read_own_job
    from pipeline.show.handing_over import copy_export, refuse_if_busy, survey_export
    from pipeline.stages import STAGES

    loaded = read_own_job(job_file, overrides, preview=preview, until=(end,))
    layout = submission_folder(job_file, loaded.job.name, output, is_changed=bool(overrides) or preview)
    waiting = JobQueue.of(layout).find(layout.root.absolute().name)
    refuse_if_busy(layout, None if waiting is None or waiting.desired is Desired.NONE else waiting.until)
    code = submit_to_queue(loaded, layout, options=options, until=(end,))
    if code or options.detach:
        if target is not None and not code:
            click.echo("what runs in the background is not copied; call again with -o when it is done", err=True)
        sys.exit(code)
    found = survey_export(load_job(layout.job_file), layout, STAGES, end)
    place = layout.root
    if target is not None:
        copied = copy_export(found, layout, target)
        place = target
        others = "" if copied == len(found.files) else "; the others were there"
        click.echo(f"{copied} of {len(found.files)} files copied into {target}{others}", err=True)
    told = found.stage.opened_by.format(file=place / found.root)
    click.echo(f"{place / found.root}: {found.told}, {wording.size(found.bytes)} in {len(found.files)} files")
    click.echo(f"  {told}")
    if found.left_out:
        click.echo(f"  left out, as {found.stage.format} has no place for it: {', '.join(found.left_out)}")


def _stage(wanted: str) -> ExportStage:
    from pipeline.stages import EXPORTS

    return EXPORTS[wanted]


def _write_openjd(job_file: Path, overrides: tuple[str, ...], *, preview: bool, output: Path, python: str) -> None:
    """Write an Open Job Description template, and the job's folder that it works in.

    A step for each stage, cut into chunks of frames where frames do not depend on each other. What the farm has made,
    `pipeline resume` takes over.
    """
    from pipeline.base.files import replace_durably
    from pipeline.base.lease import refuse_if_held
    from pipeline.base.places import check_places
    from pipeline.job.inputs import keep_inputs
    from pipeline.run.checked_job import checked, read_own_job
    from pipeline.run.executors.choice import require_named_devices
    from pipeline.run.plan import plan_job
    from pipeline.show.openjd import job_template
    from pipeline.stages import STAGES

    loaded, _ = checked(read_own_job(job_file, overrides, preview=preview))
    require_named_devices(loaded.job, [stage.name for stage in STAGES])
    print_warnings(loaded.warnings)
    layout = JobLayout((output / loaded.job.name).absolute())
    refuse_if_held(layout.lease)
    layout.root.mkdir(parents=True, exist_ok=True)
    check_places(layout)
    job, text = keep_inputs(loaded, layout)
    replace_durably(layout.job_file, text)
    described = job_template(job.name, plan_job(job, layout, STAGES), python=python)
    path = layout.root / "openjd.json"
    replace_durably(path, json.dumps(described, indent=2, ensure_ascii=False) + "\n")
    click.echo(f"wrote {path}; its job's folder is {layout.root}")
