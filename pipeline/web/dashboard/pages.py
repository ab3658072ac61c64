"""Pages and their parts, from templates that escape whatever they are given."""

import hashlib
from importlib.resources import files
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipeline.base import wording
from pipeline.base.task import TaskState
from pipeline.record.reader import TaskRow
from pipeline.web.dashboard.job_view import Question
from pipeline.web.dashboard.places import printable

FARM_PARTS = ("status", "jobs")
JOB_PARTS = ("status", "head", "stages", "work", "film", "frames", "story", "tasks", "events")
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


class Part(NamedTuple):
    """A part of a page that is replaced when it changes; `tag` changes with it."""

    html: Markup
    tag: str


class Static(NamedTuple):
    """A file that every page uses."""

    content: bytes
    media_type: str
    tag: str


class Pages:
    """The templates. Safe to share between threads."""

    def __init__(self) -> None:
        self._environment = Environment(
            loader=PackageLoader("pipeline.web.dashboard"),
            autoescape=True,
            undefined=StrictUndefined,
            finalize=_in_utf_8,
            trim_blocks=True,
            lstrip_blocks=True,
            auto_reload=False,
        )
        self._environment.filters.update(
            duration=wording.duration, size=wording.size, moment=wording.moment, about=about, reason=reason
        )
        self._environment.globals.update(job_url=job_url, query=query, static=self._static_url)
        self.static = _static_files()
        for name in self._environment.list_templates():
            self._environment.get_template(name)  # compiled and kept now, not while the first page is waited for

    def draw(self, template: str, **context: Any) -> str:
        """A whole page."""
        return self._environment.get_template(template).render(**context)

    def parts(self, names: tuple[str, ...], **context: Any) -> dict[str, Part]:
        """Parts of a page, by name."""
        found = {}
        for name in names:
            html = self._environment.get_template(f"parts/{name}.html").render(**context)
            found[name] = Part(Markup(html), _tag(html.encode()))  # noqa: S704
        return found

    def _static_url(self, name: str) -> str:
        return f"/static/{name}?{self.static[name].tag}"


def job_url(name: str, *more: object) -> str:
    """The address of a job's page, or of something below it."""
    return "/".join(["/jobs", quote(name, safe=""), *(str(each) for each in more)])


def query(question: Question, **changes: object) -> str:
    """The query of an address that asks this, with these changes; what is as usual is left out."""
    usual = Question()
    asked = question._replace(**changes)  # type: ignore[arg-type]
    said = {key: value for key, value in asked._asdict().items() if value != getattr(usual, key)}
    return f"?{urlencode(said)}" if said else "?"


def about(seconds: float) -> str:
    """A time span as an estimate is told: `under a minute`, `3 min`, `2 h 10 min`, `3 days`."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return "under a minute"
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min" if minutes and hours < 10 else f"{hours} h"
    return f"{round(hours / 24)} days"


def reason(row: TaskRow) -> str:
    """Why a task stands as it does, if its state alone does not say so."""
    return _REASONS.get(row.state) or row.message or ""


_REASONS = {
    TaskState.UPSTREAM_FAILED: "what it needs has failed",
    TaskState.PENDING: "waits for what it needs",
    TaskState.READY: "waits for a free place",
    TaskState.UP_TO_DATE: "was there already",
    TaskState.CANCELLED: "was stopped",
}


def _in_utf_8(value: Any) -> Any:
    """A value as a page shows it: messages may name paths that are not UTF-8."""
    return printable(value) if type(value) is str else value  # markup is made of what was printable


def _static_files() -> dict[str, Static]:
    """All of them, in memory: nothing else is ever served from their folder."""
    found = {}
    for item in files("pipeline.web.dashboard").joinpath("static").iterdir():
        media_type = MEDIA_TYPES.get(f".{item.name.rpartition('.')[2]}")
        if media_type is not None:
            content = item.read_bytes()
            found[item.name] = Static(content, media_type, _tag(content))
    return found


def _tag(content: bytes) -> str:
    """A digest that only tells versions apart."""
    return hashlib.blake2b(content, digest_size=9).hexdigest()
