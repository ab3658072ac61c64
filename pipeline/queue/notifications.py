"""Notifications of how a job ended: a command or a webhook on done, failed and paused.

Who gets which stands in the user's own settings, never in a job file: no job file may run code. The file is
`notify.toml` in `$XDG_CONFIG_HOME/physics-pipeline` (`~/.config/physics-pipeline`), or what `PIPELINE_NOTIFY` names:

    [[notify]]
    on = ["failed", "paused"]                                  # all three if left out
    command = ["notify-send", "{job} {event}", "{message}"]    # an argument list; there is no shell

    [[notify]]
    webhook = "https://chat.example.org/hooks/render"          # gets a JSON object by POST

A notification that fails is a warning. It changes nothing about the job.
"""

import json
import os
import platform
import re
import signal
import subprocess
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from pipeline.base.errors import DiskFullError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.queue.farm import Ended, StopReason
from pipeline.queue.states import ending_of
from pipeline.run.events import JobOutcome
from pipeline.run.goal import what_is_made

SETTINGS_VARIABLE = "PIPELINE_NOTIFY"
_SHOWN_BYTES = 2000

Event = Literal["done", "failed", "paused"]
_EVENTS: tuple[Event, ...] = ("done", "failed", "paused")


class NotifySettingsError(PipelineError):
    """The settings of notifications cannot be used; says where and why."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Notification:
    """One message about a job."""

    event: Event  # done, failed or paused
    job: str
    folder: str
    message: str  # one sentence: the film, the first failure, or why it pauses
    seconds: float = 0.0  # how long its last run took [s]; 0 if it did not come to one
    failures: tuple[str, ...] = ()  # the tasks that failed, with their messages
    host: str = platform.node()  # the machine that the runner is on

    def fill(self, text: str) -> str:
        """Put the values into a text with `{event}`, `{job}`, `{folder}` and `{message}`."""
        return re.sub(r"\{(event|job|folder|message)\}", lambda found: str(getattr(self, found[1])), text)

    def as_json(self) -> str:
        """All of it, and as `text` the sentence that chat programs look for."""
        return json.dumps({**asdict(self), "text": f"{self.job}: {self.event}: {self.message}"}, ensure_ascii=False)


_PAUSES = {StopReason.PAUSED, StopReason.DISK_SHORT}
_FAILURES = {JobOutcome.FAILED, JobOutcome.TOO_MANY_FAILURES}


def notification_of(name: str, folder: Path, ended: Ended) -> Notification | None:
    """The notification of how a turn ended; None for a job that only lets another go first, or was cancelled."""
    outcome = ended.outcome
    if ended.error is not None:
        kind: Event = "paused" if isinstance(ended.error, DiskFullError) else "failed"
        return Notification(kind, name, str(folder), str(ended.error))
    if outcome is not None and outcome.kind is JobOutcome.SUCCEEDED:
        made = what_is_made(JobLayout(folder))
        return Notification("done", name, str(folder), f"{made} is done", seconds=outcome.seconds)
    if outcome is not None and outcome.kind in _FAILURES:
        failures = tuple(f"{failed.task_id}: {failed.message}" for failed in outcome.failures)
        first = failures[0] if failures else outcome.kind.value
        return Notification("failed", name, str(folder), first, seconds=outcome.seconds, failures=failures)
    if ended.reason is None or ended.reason in _PAUSES:
        why = ended.reason or (ending_of(outcome.kind) if outcome is not None else "paused")
        seconds = 0.0 if outcome is None else outcome.seconds
        sentence = f"{why}; continue with: pipeline resume {folder}"
        return Notification("paused", name, str(folder), sentence, seconds=seconds)
    return None


class Target(BaseModel):
    """One command or webhook, and what it is for."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    on: tuple[Event, ...] = _EVENTS
    command: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    webhook: str | None = None
    headers: Mapping[str, str] = {}
    timeout_s: Annotated[float, Field(gt=0, le=300)] = 20.0

    @field_validator("webhook")
    @classmethod
    def _is_web_address(cls, value: str | None) -> str | None:
        if value is not None and (urlsplit(value).scheme not in {"http", "https"} or not urlsplit(value).hostname):
            raise ValueError("a webhook is an address like https://example.org/hook")
        return value

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if (self.command is None) == (self.webhook is None):
            raise ValueError("give either a command or a webhook")
        return self


class Settings(BaseModel):
    """All targets."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    notify: tuple[Target, ...] = ()


def settings_path(environment: Mapping[str, str]) -> Path | None:
    """Where the settings are; None if there are to be none. A relative XDG_CONFIG_HOME counts as none."""
    named = environment.get(SETTINGS_VARIABLE)
    if named is not None:
        return Path(named) if named else None
    folder = Path(environment.get("XDG_CONFIG_HOME", ""))
    base = folder if folder.is_absolute() else Path.home() / ".config"
    path = base / "physics-pipeline" / "notify.toml"
    return path if path.exists() else None


def load_targets(path: Path | None) -> tuple[Target, ...]:
    """Read the settings. Raises NotifySettingsError with all that is wrong in them."""
    if path is None:
        return ()
    try:
        return Settings.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))).notify
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise NotifySettingsError(f"{path}: {error}") from error
    except ValidationError as error:
        lines = [f"{path} {'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()]
        raise NotifySettingsError("\n".join(lines)) from error


def send(notification: Notification, environment: Mapping[str, str] = os.environ) -> list[str]:
    """Tell everybody who wants to know. Returns what went wrong, a sentence each; raises nothing for that."""
    try:
        targets = load_targets(settings_path(environment))
    except (NotifySettingsError, RuntimeError, OSError) as error:  # nobody's home, a folder that may not be looked into
        return [f"nobody was notified: {line}" for line in str(error).splitlines()]
    return [
        problem
        for target in targets
        if notification.event in target.on and (problem := _tell(target, notification)) is not None
    ]


def _tell(target: Target, notification: Notification) -> str | None:
    try:
        if target.command is not None:
            _run(target.command, notification, target.timeout_s)
        elif target.webhook is not None:
            _post(target.webhook, notification, target)
    except _NotTold as error:
        return f"notification of {notification.job}: {error}"
    return None


class _NotTold(Exception):  # noqa: N818 - it never gets out of here
    """One target was not reached."""


def _run(command: tuple[str, ...], notification: Notification, timeout_s: float) -> None:
    """Run a command in a process group of its own; it gets the JSON object on its standard input."""
    arguments = [command[0], *map(notification.fill, command[1:])]
    try:
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise _NotTold(f"{command[0]} did not start: {error}") from error
    try:
        output, _ = process.communicate(notification.as_json().encode(), timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise _NotTold(f"{command[0]} was not done after {timeout_s:g} s and was ended") from None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode != 0:
        shown = output[-_SHOWN_BYTES:].decode(errors="replace").strip()
        raise _NotTold(f"{command[0]} exited with {process.returncode}{': ' if shown else ''}{shown}")


class _NoRedirects(HTTPRedirectHandler):
    """A redirected POST would arrive as a GET without content; better say so."""

    def redirect_request(self, *_: object) -> None:
        """Follow none."""


def _post(address: str, notification: Notification, target: Target) -> None:
    headers = {"Content-Type": "application/json", "User-Agent": "physics-pipeline", **target.headers}
    request = Request(address, data=notification.as_json().encode(), headers=headers, method="POST")  # noqa: S310
    host = urlsplit(address).hostname
    try:
        with build_opener(_NoRedirects).open(request, timeout=target.timeout_s) as answer:
            answer.read(_SHOWN_BYTES)
    except (HTTPException, OSError, ValueError) as error:  # an answer that is no HTTP is a kind of its own
        raise _NotTold(f"the webhook at {host} was not reached: {error}") from error
