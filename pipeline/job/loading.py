"""A job file becomes a Job: read, changed by options, validated; every problem at once."""

import re
import shlex
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import ConvertError

from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.input_files import InputFile, input_files
from pipeline.job.overrides import Override, OverrideError, apply_overrides, parse_override
from pipeline.job.presets import preview_overrides
from pipeline.job.standing import StandingPart
from pipeline.model.job import Job
from pipeline.model.meshes import with_written
from pipeline.model.problems import JobSource

MAX_BYTES = 2**20
"""No person writes a larger job file; a film given by mistake is refused before it is read."""
MAX_DEPTH = 32
"""Four times what any job needs; keeps recursive code far from Python's limit."""
MOST_JOBS = 16

_TEXT_OR_COMMENT = re.compile(
    r'"""(?:[^\\]|\\.)*?"""|' + r"'''.*?'''" + r'|"(?:[^"\\\n]|\\.)*"' + r"|'[^'\n]*'|#[^\n]*", re.DOTALL
)
_BETWEEN_KEYS = re.compile(r"[=,{}\[\]\n]")
_DIGEST = re.compile("[0-9a-f]{64}")
_SYNTAX_POSITION = re.compile(
    r"(?P<what>.*) \(at (?:line (?P<line>\d+), column (?P<column>\d+)|end of document)\)", re.DOTALL
)


@dataclass(frozen=True)
class LoadedJob:
    """A valid job, and the text to keep of it."""

    job: Job  # the job; its files (meshes, the Blender executable) are absolute paths
    text: str  # self-contained TOML: overrides applied, files absolute. Loading it anywhere gives the same job
    path: Path  # the file it was read from
    source: JobSource  # turns a problem into a line with its place
    warnings: tuple[str, ...] = ()  # what is worth a look, one line each


class InvalidJobError(JobFileError):
    """A job file whose keys or values are wrong; what stands of it can be looked at as a scene."""

    def __init__(self, lines: list[str], standing: StandingPart, source: JobSource, path: Path) -> None:
        super().__init__(lines)
        self.args = (lines, standing, source, path)
        self.standing, self.source, self.path = standing, source, path

    def standing_job(self) -> Job | None:
        """The part of the job that stands, its files absolute; None if nothing does."""
        job = self.standing.job
        if job is None:
            return None
        for change in _absolute_files(job, self.path):
            job = with_written(job, change.path, change.value)
        return job


def load_job(path: Path | str, overrides: Sequence[str] = (), *, preview: bool = False) -> Job:
    """The job in a file, as of `read_job`."""
    return read_job(path, overrides, preview=preview).job


def read_job(path: Path | str, overrides: Sequence[str] = (), *, preview: bool = False) -> LoadedJob:
    """Read and validate a job file; the scene itself is looked at by `check_job`.

    `overrides` are arguments of `--set`, applied in order; `preview` makes it the fast, small version of the job.

    Raises JobFileError: carries every problem found.
    """
    path = Path(path)
    return _load(path, _read_text(path), overrides, preview=preview)


def make_job(**tables: Any) -> LoadedJob:
    """A job of keyword arguments that are called like the keys and tables of the job file.

    Tables are dicts, several of one name a list of them; arrays, tuples and paths may be given, and None is a key left
    out. Relative files are of the working folder.

    Raises JobFileError: carries every problem found.
    """
    try:
        text = tomlkit.dumps(_as_toml(tables))
    except ConvertError as error:
        raise JobFileError([f"make_job: no job file can hold that: {error}"]) from None
    return _load(Path("make_job"), text, (), preview=False, source=JobSource("make_job", ""))


def _as_toml(value: Any) -> Any:
    """A value of Python and numpy as TOML has it."""
    if isinstance(value, Mapping):
        return {str(key): _as_toml(child) for key, child in value.items() if child is not None}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_as_toml(child) for child in value]
    return str(value) if isinstance(value, Path) else value


def _load(
    path: Path, text: str, overrides: Sequence[str], *, preview: bool, source: JobSource | None = None
) -> LoadedJob:
    """The job of a text; `source` has the places of its keys, those in the text if omitted."""
    changes = _parse_overrides(overrides, _parse(path, text)) if overrides else []
    source = source or JobSource(path.name, text, {change.path: change.origin for change in changes})
    if changes:
        text = changed_text(text, changes)
    job, text = _with_absolute_files(_job_of(path, text, source), text, path)
    if preview:
        preview_changes = preview_overrides(job)
        source.options.update({change.path: change.origin for change in preview_changes})
        text = changed_text(text, preview_changes)
        job = _job_of(path, text, source)
    return LoadedJob(job=job, text=text, path=path, source=source)


def job_of_text(text: str, path: Path) -> Job:
    """The job that `load_job` will find in a file once this text is written to it; raises JobFileError."""
    return _with_absolute_files(_job_of(path, text, JobSource(path.name, text)), text, path)[0]


def _read_text(path: Path) -> str:
    try:
        if path.is_dir():
            raise JobFileError([f"{path}: is a folder, not a job file"])
        if path.exists() and not path.is_file():
            raise JobFileError([f"{path}: is no file"])  # a device or a pipe may never end
        if path.stat().st_size > MAX_BYTES:
            raise JobFileError([f"{path}: {path.stat().st_size / 1e6:.0f} MB is not a job file; a few KB are usual"])
        return path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
    except FileNotFoundError:
        raise JobFileError([f"{path}: no such file; `pipeline new NAME` writes a starter"]) from None
    except UnicodeDecodeError as error:
        byte = f"byte {error.start} is 0x{error.object[error.start]:02x}"
        raise JobFileError([f"{path}: not UTF-8 text ({byte}){_remedy(path)}"]) from None
    except (OSError, ValueError) as error:
        raise JobFileError([f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]) from None


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        if _longest_key(text) > MAX_DEPTH:  # reading it would take time by the square of its length
            raise JobFileError([f"{path.name}: nested too deeply"])
        document = tomllib.loads(text)
        if _depth(document) > MAX_DEPTH:
            raise JobFileError([f"{path.name}: nested too deeply"])
    except tomllib.TOMLDecodeError as error:
        raise JobFileError([f"{_syntax_error(path, text, str(error))}{_remedy(path)}"]) from None
    except RecursionError:
        raise JobFileError([f"{path.name}: nested too deeply"]) from None
    except ValueError:  # of Python, which reads no whole number of that length
        raise JobFileError(
            [f"{path.name}: a whole number has more than {sys.get_int_max_str_digits()} digits"]
        ) from None
    return document


def _longest_key(text: str) -> int:
    """Most parts of a dotted key, at least: texts and comments do not count."""
    bare = _TEXT_OR_COMMENT.sub(lambda found: "" if found[0].startswith("#") else "_", text)
    return max(piece.count(".") + 1 for piece in _BETWEEN_KEYS.split(bare))


def _remedy(path: Path) -> str:
    """How to get back the damaged job file of a job's folder, if texts of earlier runs are kept there."""
    layout = JobLayout(path.parent)
    if path.name != layout.job_file.name:
        return ""
    texts = [each for each in layout.job_text("").parent.glob("*.toml") if _DIGEST.fullmatch(each.stem)]
    if not texts:
        return ""
    latest = max(texts, key=lambda each: each.stat().st_mtime)
    return f"; that of its last run is kept: cp {shlex.quote(str(latest))} {shlex.quote(str(path))}"


def _depth(document: Any) -> int:
    """Levels of tables and lists; without recursion, as the answer may be large."""
    depth, level = 0, [document]
    while level := [
        child
        for each in level
        if isinstance(each, dict | list)
        for child in (each.values() if isinstance(each, dict) else each)
    ]:
        depth += 1
    return depth


def _syntax_error(path: Path, text: str, message: str) -> str:
    match = _SYNTAX_POSITION.fullmatch(message)
    if match is None:
        return f"{path.name}: {message}"
    lines = text.split("\n")
    line = int(match["line"]) if match["line"] else len(lines)
    column = int(match["column"]) if match["column"] else len(lines[-1]) + 1
    written = lines[line - 1].strip()
    shown = f": {written}" if written else ""
    what = f"{match['what'][:1].lower()}{match['what'][1:]}"
    return f"{path.name}:{line}:{column} {what}{shown}{_syntax_hint(match['what'], written)}"


def _syntax_hint(what: str, written: str) -> str:
    """The usual cause of a syntax error: a key given twice, or a text without quotes."""
    if what == "Cannot overwrite a value":
        return "; this key has a value already"
    key, equals, value = (part.strip() for part in written.partition("="))
    if equals and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./+-]*", value) and value not in ("true", "false", "inf", "nan"):
        return f'; a text needs quotes: {key} = "{value}"'
    return ""


def _parse_overrides(arguments: Sequence[str], document: Mapping[str, Any]) -> list[Override]:
    changes, problems = [], []
    for argument in arguments:
        try:
            changes.append(parse_override(argument, document))
        except OverrideError as error:
            problems.append(str(error))
    if problems:
        raise JobFileError(problems)
    return changes


def changed_text(text: str, changes: Sequence[Override]) -> str:
    """A job file's text with these keys changed, comments and order kept; raises JobFileError."""
    try:
        return apply_overrides(text, changes)
    except OverrideError as error:
        raise JobFileError([str(error)]) from None


_JOBS: dict[str, Job] = {}
"""The jobs that this process has validated, by their text; the latest `MOST_JOBS`."""


def _job_of(path: Path, text: str, source: JobSource) -> Job:
    """The job that a text describes, its files as the text names them; each text is validated once a process."""
    if text not in _JOBS:
        standing = StandingPart(_parse(path, text))
        if standing.job is None or standing.problems:
            raise InvalidJobError(source.describe_all(standing.problems), standing, source, path)
        _remember(text, standing.job)
    return _JOBS[text]


def _remember(text: str, job: Job) -> None:
    _JOBS[text] = job
    while len(_JOBS) > MOST_JOBS:
        del _JOBS[next(iter(_JOBS))]


def _with_absolute_files(job: Job, text: str, path: Path) -> tuple[Job, str]:
    """A job and its text with relative files, which are of the text's own folder, named by absolute paths."""
    changes = _absolute_files(job, path)
    if not changes:
        return job, text
    text = changed_text(text, changes)
    for change in changes:
        job = with_written(job, change.path, change.value)
    _remember(text, job)
    return job, text


def _absolute_files(job: Job, path: Path) -> list[Override]:
    files = list(input_files(job))
    if job.render.blender is not None:
        files.append(InputFile(("render", "blender"), job.render.blender, "program"))
    folder = path.resolve().parent
    return [
        Override(file.place, file.written((folder / file.path).as_posix()), path.name)
        for file in files
        if not Path(file.path).is_absolute()
    ]
