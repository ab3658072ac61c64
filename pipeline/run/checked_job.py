"""The check of a job before any work: what its file describes, and what its stages can do here."""

import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.checks.job import check_description
from pipeline.job.loading import InvalidJobError, LoadedJob, read_job
from pipeline.job.magnitudes import check_magnitudes
from pipeline.model.job import Job
from pipeline.model.problems import Findings, Problem, suggestion
from pipeline.stages import STAGES
from pipeline.stages.movie import MovieStage

PICTURE_KEYS = frozenset({"camera", "light", "set", "material", "render", "movie"})
"""Tables of the job file that decide nothing but pictures."""

BLENDER_VARIABLE = "PIPELINE_BLENDER"
"""Names the Blender that job files may name, too."""


def needs_pictures(until: Sequence[str]) -> bool:
    """Whether a job that ends after these stages draws anything; one that is named wrongly counts as if it did."""
    draws = {stage.name: stage.draws for stage in STAGES}
    return not until or any(draws.get(each.partition(":")[0], True) for each in until)


def without_pictures(findings: Findings) -> Findings:
    """What was found, but for what is about pictures alone."""
    errors, warnings = (
        [each for each in problems if not each.path or each.path[0] not in PICTURE_KEYS]
        for problems in (findings.errors, findings.warnings)
    )
    return replace(findings, errors=errors, warnings=warnings)


def check_job(job: Job, *, memory_bytes: int | None = None, until: Sequence[str] = ()) -> Findings:
    """Look at the whole job, with absolute mesh paths: everything that can be known before any work starts.

    Reads the mesh files and fills the fluid's blocks, so it takes a second or two for a large scene. The simulation may
    use `memory_bytes`, this machine's if omitted. What is about pictures alone does not count if the job, which ends
    after the stages `until`, draws none.
    """
    findings = check_description(job, memory_bytes)
    for obstacle in MovieStage().preflight(job):
        findings.error(("movie", "codec"), obstacle)
    _check_limits(job, findings)
    return findings if needs_pictures(until) else without_pictures(findings)


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


def read_own_job(
    path: Path | str, overrides: Sequence[str] = (), *, preview: bool = False, until: Sequence[str] = ()
) -> LoadedJob:
    """A job file that names no program but the user's own.

    Raises JobFileError with every problem; if keys or values are wrong, with those of the scene that is left, too.
    """
    try:
        loaded = read_job(path, overrides, preview=preview)
    except InvalidJobError as error:
        raise _with_findings(error, until) from None
    require_own_programs(loaded, overrides)
    return loaded


def require_own_programs(loaded: LoadedJob, overrides: Sequence[str]) -> None:
    """Refuse (JobFileError) a job file that names a program to be run: whose file it is does not decide what runs here.

    The user names it with `--set`, or in the environment. A job's folder keeps what its user has named.
    """
    program = loaded.job.render.blender
    if program is None or any(override.replace(" ", "").startswith("render.blender=") for override in overrides):
        return
    if loaded.path.name == "job.toml" and JobLayout(loaded.path.parent).manifest.exists():
        return
    if os.environ.get(BLENDER_VARIABLE) != program:
        raise JobFileError(
            [
                f"{loaded.path.name}: render.blender names a program, and a job file may not choose what runs here; "
                f"if you trust it: --set render.blender={shlex.quote(program)}"
            ]
        )


def require_plannable(loaded: LoadedJob) -> None:
    """Refuse (JobFileError) numbers that planning would overflow with, before the whole scene is looked at."""
    findings = Findings()
    if not check_magnitudes(loaded.job, findings):
        raise JobFileError(loaded.source.describe_all(findings.errors))


def checked(loaded: LoadedJob, until: Sequence[str] = ()) -> tuple[LoadedJob, Findings]:
    """A job that was read, with its warnings, and what was found of it. Raises JobFileError with every problem."""
    findings = check_job(loaded.job, until=until)
    if findings.errors:
        raise JobFileError(loaded.source.describe_all(findings.errors))
    return replace(loaded, warnings=tuple(loaded.source.describe_all(findings.warnings))), findings


def _with_findings(error: InvalidJobError, until: Sequence[str]) -> JobFileError:
    """The error with the problems of the scene that the rest of the file describes."""
    job, standing = error.standing_job(), error.standing
    if job is None:
        return error
    found = [Problem(standing.written(each.path), each.message) for each in check_job(job, until=until).errors]
    found = [each for each in found if not standing.may_follow(each)]
    return JobFileError(error.source.describe_all([*standing.problems, *found]))
