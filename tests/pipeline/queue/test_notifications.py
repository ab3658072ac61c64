"""Notifications: to a real server and by real commands; their failures are warnings."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from processes_seen import pid_lives

from pipeline.base.errors import DiskFullError, PipelineError
from pipeline.queue.farm import Ended
from pipeline.queue.notifications import (
    Notification,
    NotifySettingsError,
    load_targets,
    notification_of,
    send,
    settings_path,
)

DONE = Notification("done", "dam break", "/films/dam", "the film; it's $(here) {job}", seconds=12.5)


class Hook:
    """A web server that keeps what it is told."""

    def __init__(self, status: int = 200, pause_s: float = 0.0) -> None:
        self.told: list[tuple[dict[str, Any], dict[str, str]]] = []
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                hook.told.append((json.loads(body), dict(self.headers)))
                time.sleep(pause_s)
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", "/elsewhere")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/hook"
        self._thread = threading.Thread(target=self._server.serve_forever)

    def __enter__(self) -> Hook:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@pytest.fixture
def hook() -> Iterator[Hook]:
    with Hook() as hook:
        yield hook


def settings(tmp_path: Path, text: str) -> dict[str, str]:
    (tmp_path / "notify.toml").write_text(text)
    return {"PIPELINE_NOTIFY": str(tmp_path / "notify.toml")}


def command(program: str, *arguments: str, more: str = "") -> str:
    return f"[[notify]]\ncommand = {json.dumps([sys.executable, '-c', program, *arguments])}\n{more}\n"


def test_a_webhook_gets_a_json_object(tmp_path, hook):
    text = f'[[notify]]\nwebhook = "{hook.address}"\nheaders = {{ Authorization = "Bearer 123" }}'
    assert send(DONE, settings(tmp_path, text)) == []
    [(body, headers)] = hook.told
    assert (body["event"], body["job"], body["seconds"]) == ("done", "dam break", 12.5)
    assert body["text"] == "dam break: done: the film; it's $(here) {job}"
    assert headers["Authorization"] == "Bearer 123"


def test_a_command_gets_its_arguments_as_they_are_and_the_object_on_its_input(tmp_path):
    program = "import json, sys, pathlib; pathlib.Path(sys.argv[1]).write_text(repr(sys.argv[2:]) + sys.stdin.read())"
    text = command(program, str(tmp_path / "told"), "{event}: {message}", "{unknown}")
    assert send(DONE, settings(tmp_path, text)) == []
    told = (tmp_path / "told").read_text()
    # No shell looked at it, and what a value holds is not filled in again.
    assert told.startswith(repr(["done: the film; it's $(here) {job}", "{unknown}"]))
    assert '"folder": "/films/dam"' in told


def test_only_what_is_asked_for_is_told(tmp_path, hook):
    environment = settings(tmp_path, f'[[notify]]\non = ["failed"]\nwebhook = "{hook.address}"')
    assert send(DONE, environment) == []
    assert send(Notification("failed", "dam", "/films/dam", "render/000003: no room"), environment) == []
    assert [body["event"] for body, _ in hook.told] == ["failed"]


def test_what_fails_is_told_and_the_others_are_notified(tmp_path, hook):
    text = command("import sys; sys.exit('no display')") + f'[[notify]]\nwebhook = "{hook.address}"'
    [problem] = send(DONE, settings(tmp_path, text))
    assert problem.endswith("exited with 1: no display")
    assert len(hook.told) == 1


def test_a_command_that_hangs_is_ended_with_its_children(tmp_path):
    program = (
        "import subprocess, sys, time, pathlib\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "pathlib.Path(sys.argv[1]).write_text(str(child.pid))\n"
        "time.sleep(600)"
    )
    text = command(program, str(tmp_path / "pid"), more="timeout_s = 15.0")
    [problem] = send(DONE, settings(tmp_path, text))
    assert "was not done after 15 s and was ended" in problem
    child = int((tmp_path / "pid").read_text())
    until = time.monotonic() + 10.0
    while pid_lives(child):
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.parametrize(("status", "reason"), [(500, "500"), (302, "302")])
def test_a_webhook_that_refuses_is_a_warning(tmp_path, status, reason):
    with Hook(status) as hook:
        [problem] = send(DONE, settings(tmp_path, f'[[notify]]\nwebhook = "{hook.address}"'))
    assert problem.startswith("notification of dam break: the webhook at 127.0.0.1 was not reached: ")
    assert reason in problem
    assert len(hook.told) == 1


def test_a_webhook_that_does_not_answer_is_a_warning(tmp_path):
    with Hook(pause_s=1.0) as hook:
        [problem] = send(DONE, settings(tmp_path, f'[[notify]]\nwebhook = "{hook.address}"\ntimeout_s = 0.2'))
    assert "timed out" in problem


def test_what_is_no_web_server_is_a_warning(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            caller, _ = server.accept()
            with caller:
                caller.recv(65536)
                caller.sendall(b"SSH-2.0-OpenSSH_9.2\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        text = f'[[notify]]\nwebhook = "http://127.0.0.1:{server.getsockname()[1]}/"'
        [problem] = send(DONE, settings(tmp_path, text))
        thread.join()
    assert "was not reached: SSH-2.0" in problem


@pytest.mark.parametrize(
    ("address", "reason"),
    [("http://127.0.0.1:9/my hook", "URL can't contain control characters"), ("http://127.0.0.1:9/", "refused")],
)
def test_an_address_that_nobody_answers_is_a_warning(tmp_path, address, reason):
    [problem] = send(DONE, settings(tmp_path, f'[[notify]]\nwebhook = "{address}"'))
    assert "was not reached: " in problem
    assert reason in problem


def test_without_a_home_nobody_is_notified_and_that_is_a_warning(monkeypatch):
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    assert send(DONE, {}) == ["nobody was notified: Could not determine home directory."]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[[notify]]\n", "give either a command or a webhook"),
        ("[[notify]]\ncommand = []\n", "at least 1 item"),
        ('[[notify]]\ncommand = "rm -rf /"\n', "valid tuple"),
        ('[[notify]]\nwebhook = "file:///etc/passwd"\n', "a webhook is an address like https://"),
        ('[[notify]]\nwebhook = "https://example.org"\nwehn = 3\n', "Extra inputs are not permitted"),
        ('[[notify]]\non = ["never"]\nwebhook = "https://example.org"\n', "'done', 'failed' or 'paused'"),
        ("notify = [\n", "notify.toml"),
    ],
)
def test_wrong_settings_are_told_and_stop_nothing(tmp_path, text, complaint):
    environment = settings(tmp_path, text)
    with pytest.raises(NotifySettingsError, match=complaint):
        load_targets(settings_path(environment))
    problems = send(DONE, environment)
    assert problems
    assert all(problem.startswith("nobody was notified: ") for problem in problems)


def test_settings_are_the_users_own(tmp_path):
    file = tmp_path / "physics-pipeline" / "notify.toml"
    file.parent.mkdir()
    file.write_text("")
    assert settings_path({"XDG_CONFIG_HOME": str(tmp_path)}) == file
    assert settings_path({"XDG_CONFIG_HOME": str(tmp_path), "PIPELINE_NOTIFY": ""}) is None
    assert send(DONE, {"XDG_CONFIG_HOME": str(tmp_path / "absent")}) == []
    missing = {"PIPELINE_NOTIFY": str(tmp_path / "absent.toml")}
    assert "No such file" in send(DONE, missing)[0]


@pytest.mark.parametrize(
    ("error", "kind"), [(DiskFullError("the disk is full"), "paused"), (PipelineError("no"), "failed")]
)
def test_a_full_disk_pauses_a_job_and_fails_it_not(error, kind):
    told = notification_of("film", Path("renders/film"), Ended(None, error=error))
    assert told is not None
    assert (told.event, told.message) == (kind, str(error))
