"""A dashboard in a process of its own, and a browser-like client for it."""

import http.client
import json
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode, urlsplit

import numpy as np
from farm_processes import Farm
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import FailureKind, Task, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.run.events import JobOutcome
from pipeline.store.receipts import Receipt


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Client:
    """Sends requests as they are, and keeps the session's cookie."""

    def __init__(self, address: str) -> None:
        self.place = urlsplit(address).netloc
        self.cookie = ""
        self._form_token = ""

    def ask(self, path: str, *, method: str = "GET", body: str | None = None, **headers: str | None) -> Answer:
        """A header of None is left out; "_" stands for "-"."""
        sent: dict[str, str | None] = {"Host": self.place, "Cookie": self.cookie or None}
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection(self.place, timeout=60)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in sent.items():
                if value is not None:
                    connection.putheader(name, value)
            if body is not None:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(None if body is None else body.encode())
            answer = connection.getresponse()
            found = Answer(answer.status, {name.lower(): text for name, text in answer.getheaders()}, answer.read())
        finally:
            connection.close()
        if "set-cookie" in found.headers:
            self.cookie = found.headers["set-cookie"].partition(";")[0]
        return found

    def form_token(self) -> str:
        """What forms of this session have, from the first page on that has one."""
        if not self._form_token:
            found = re.search(r'name="form_token" value="([0-9a-f]+)"', self.ask("/").text)
            assert found is not None
            self._form_token = found[1]
        return self._form_token

    def post(self, path: str, *, value: str = "", token: str | None = None, **headers: str | None) -> Answer:
        """Press a button, as a page does; a token and headers take the place of its own."""
        form = {"value": value, "form_token": self.form_token() if token is None else token}
        usual = {"Origin": f"http://{self.place}", "Accept": "application/json"}
        return self.ask(path, method="POST", body=urlencode(form), **(usual | headers))


@contextmanager
def dashboard(farm: Farm, *options: str, folder: str = "renders") -> Iterator[tuple[Client, subprocess.Popen[str]]]:
    """`pipeline dashboard` of a farm of synthetic jobs, on a free port."""
    (farm.folder / folder).mkdir(exist_ok=True)
    process = farm.start("dashboard", "--port", "0", "--farm", folder, *options)
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address.startswith("http://"), process.communicate(timeout=30)
    try:
        yield Client(address), process
    finally:
        if process.poll() is None:
            process.terminate()
            farm.finish(process)


def frame_job(layout: JobLayout, frames: int, *, message: str = "") -> list[Task]:
    """The record of a job whose one stage draws frames, none drawn yet; with a message, the first one has failed."""
    parameters = ParameterSet.of(stage="render", version=1, tools={})
    tasks = [
        Task(TaskId(f"render/{k:06d}"), "render", (), (JobLayout.picture(k),), parameters, frame=k)
        for k in range(frames)
    ]
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(f'name = "{layout.root.name}"\n')
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run(layout.root.name, run="test")
        manifest.record_plan(tasks)
        if message:
            number = manifest.start_attempt(tasks[0].id)
            manifest.finish_attempt(
                tasks[0].id, number, failure=FailureKind.FAILED, message=message, state=TaskState.FAILED
            )
        manifest.end_run(JobOutcome.FAILED if message else JobOutcome.SUCCEEDED)
    return tasks


def draw_frame(layout: JobLayout, manifest: Manifest, task: Task, *, size: tuple[int, int] = (640, 360)) -> Path:
    """Commit a frame with its receipt, as a run does; returns the picture."""
    [artifact] = task.outputs
    path = layout.path(artifact)
    path.parent.mkdir(exist_ok=True)
    rows = np.linspace(0, 255, size[1], dtype=np.uint8)[:, None, None]
    colour = np.array([1.0, 0.6, 0.2 + 0.1 * (task.frame or 0)])
    Image.fromarray((rows * colour).astype(np.uint8).repeat(size[0], axis=1)).save(path)
    receipt = Receipt(
        artifact=artifact,
        task=task.id,
        stage=task.stage,
        attempt=1,
        fingerprint="f",
        parameters=task.parameters.digest,
        size=path.stat().st_size,
        mtime_ns=path.stat().st_mtime_ns,
        hash=ParameterSet("picture").digest,
        inputs={},
    )
    layout.receipt(artifact).parent.mkdir(parents=True, exist_ok=True)
    layout.receipt(artifact).write_text(receipt.to_json())
    number = manifest.start_attempt(task.id)
    manifest.record_artifact(receipt)
    manifest.finish_attempt(task.id, number, seconds=1.0, state=TaskState.SUCCEEDED)
    return path
