"""Job folders made by somebody else: no command writes, touches or removes anything outside of them."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import drawing_stages
import pytest
from click.testing import Result
from command_line import pipeline
from synthetic_jobs import job_text

from pipeline.base.layout import JobLayout
from pipeline.cli.main import SECTIONS
from pipeline.store.receipts import hash_file

READERS = {"new", "check", "plan", "status", "explain", "view", "live", "doctor", "schema", "dashboard"}
"""Commands that write and remove nothing in a job's folder."""

OF_QUEUE = {"pause", "cancel", "priority"}
"""Commands that only change the job's entry in the queue, which lies beside its folder."""

WRITERS = {
    "submit": [["{file}", "--farm", "{farm}"], ["{job}/job.toml"]],
    "sweep": [["{file}", "--farm", "{farm}", "--set", "frames=1,2", "--executor", "inline"]],
    "rerun": [["{job}", "--failed"], ["{job}", "--stage", "render"]],
    "resume": [["{job}"]],
    "work": [["{job}", "--stage", "simulate"], ["{job}", "--stage", "render"]],
    "export": [["{file}", "--to", "openjd", "--farm", "{farm}", "--set", "device=cpu", "--set", "render.device=cpu"]],
    "still": [["{job}", "--frame", "0"], ["{job}", "--sheet"]],
    "animatic": [["{job}"]],
    "compare": [["{job}", "{job}", "-o", "{farm}/pair.mp4"]],
    "loop": [["{job}", "-o", "{farm}/loop.webp"]],
    "report": [["{job}"]],
    "verify": [["{job}"], ["{job}", "--deep"], ["{job}", "--rebuild"]],
    "clean": [
        *([["{job}", "--stage", stage, "--yes"] for stage in ("simulate", "render", "movie")]),
        ["{job}", "--superseded", "--checkpoints", "--yes"],
        ["{job}", "--all", "--yes"],
    ],
}
"""How all others are called."""

ROWS = ("../outside/frames/000000.png", "{outside}/frames/000000.png", "frames/../../outside/frames/000000.png")
PICTURE = "frames/000000.png"
LINKS = (
    *("frames", "cache", "cache/checkpoints", "logs", "stills", "inputs", "rejected", ".receipts", ".receipts/frames"),
    *(".provenance/jobs", ".so-far", "frames/000000.png", "job.toml", "manifest.db", "runner.lease", "report.html"),
    "siblings.json",
)


@pytest.fixture(autouse=True, scope="module")
def drawing() -> Iterator[None]:
    """Films take a moment: most commands that are called make what is spoilt anew."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES_WITH_CACHE)
        patch.setattr("pipeline.queue.turns.STAGES_REFERENCE", drawing_stages.WITH_CACHE)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, drawing: None) -> Path:
    """The folder of a finished job, of which each call has a copy."""
    file = tmp_path_factory.mktemp("finished") / "synthetic.toml"
    file.write_text(job_text(frames=2))
    ended = pipeline("submit", file, "--farm", file.parent, "--executor", "inline")
    assert ended.exit_code == 0, ended.output
    return file.with_suffix("")


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder of somebody's beside the farm, with files of every name that a job has."""
    folder = tmp_path / "outside"
    for name in (PICTURE, "cache/000000.h5", "cache/checkpoints/000000.h5", "logs/render/000000.1.log", "stills/a.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("somebody's")
    for name in LINKS:
        place = folder / name
        if not place.suffix:
            place.mkdir(parents=True, exist_ok=True)
        elif not place.exists():
            place.write_text("somebody's")
    return folder


def state(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Modification time [ns] and content of everything in a folder."""
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in sorted(folder.rglob("*"))
    }


def calls(root: Path) -> list[list[str]]:
    """Every way to write into a job's folder or to remove something of it."""
    places = {"job": root, "farm": root.parent, "file": root.with_suffix(".toml")}
    return [
        [command, *(argument.format(**places) for argument in way)] for command, ways in WRITERS.items() for way in ways
    ]


def sweep(finished: Path, outside: Path, spoil: Callable[[JobLayout], None]) -> list[tuple[str, Result]]:
    """Call every command that does not just read on a spoilt copy of the folder; returns how each ended."""
    before, answers = state(outside), []
    for number in range(sum(map(len, WRITERS.values()))):
        root = outside.parent / f"farm-{number}" / finished.name
        command = calls(root)[number]
        shutil.copytree(finished, root)
        shutil.copyfile(finished.with_suffix(".toml"), root.with_suffix(".toml"))
        spoil(JobLayout(root))
        ended = pipeline(*command)
        assert state(outside) == before, command
        assert ended.exception is None or isinstance(ended.exception, SystemExit), (command, ended.exception)
        answers.append((command[0], ended))
    return answers


def test_every_command_is_swept() -> None:
    assert {each.name for commands in SECTIONS.values() for each in commands} == READERS | OF_QUEUE | {*WRITERS}


def record(layout: JobLayout, path: str, file: Path) -> None:
    """Put a file on record as a rendered picture."""
    with closing(sqlite3.connect(layout.manifest)) as manifest, manifest:
        manifest.execute(
            "INSERT OR REPLACE INTO artifact SELECT ?, task, attempt, fingerprint, parameters, ?, ?, ?, inputs, device"
            " FROM artifact WHERE task = 'render/000001'",
            (path, file.stat().st_size, file.stat().st_mtime_ns, hash_file(file)),
        )
        manifest.execute("UPDATE artifact SET task = 'render/000000' WHERE path = ?", (path,))


@pytest.mark.parametrize("recorded", ROWS)
def test_recorded_paths_do_not_lead_outside(finished: Path, outside: Path, recorded: str) -> None:
    def spoil(layout: JobLayout) -> None:
        record(layout, recorded.format(outside=outside), outside / PICTURE)

    answers = sweep(finished, outside, spoil)
    refused = [name for name, ended in answers if ended.exit_code and "speaks of a file outside" in ended.output]
    assert refused == ["report", "verify", "verify", *4 * ["clean"]]
    healed = [name for name, ended in answers if "was damaged and is made anew of" in ended.output]
    assert healed == ["submit", "submit", "rerun", "resume"]


@pytest.mark.parametrize("link", LINKS)
def test_links_do_not_lead_outside(finished: Path, outside: Path, link: str) -> None:
    def spoil(layout: JobLayout) -> None:
        place = layout.root / link
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(outside / link)
        if link != "manifest.db":
            record(layout, PICTURE, outside / PICTURE)

    sweep(finished, outside, spoil)
