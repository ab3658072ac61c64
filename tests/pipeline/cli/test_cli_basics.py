"""Commands as a user calls them: what they print, where, and with which exit code."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete
from command_line import pipeline
from places import PROJECT

from pipeline.base.layout import JobLayout
from pipeline.cli.main import main
from pipeline.cli.make import TEMPLATES
from pipeline.job import starter


@pytest.fixture
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_help_of_every_command_shows_an_example():
    assert pipeline("--help").exit_code == 0
    for name in main.commands:
        result = pipeline(name, "--help")
        assert result.exit_code == 0
        assert f"pipeline {name}" in result.stdout.split("Options:")[0].partition("\n")[2], name


def test_options_of_where_and_how_mean_the_same_in_every_command():
    places = {
        (flag, option.name)
        for command in main.commands.values()
        for option in command.params
        for flag in option.opts
        if flag in ("-o", "--output", "--to", "--farm") or option.name in ("target", "output")
    }
    assert places == {("-o", "target"), ("--output", "target"), ("--to", "wanted"), ("--farm", "output")}


def test_new_writes_a_file_that_check_accepts(in_tmp_path):
    result = pipeline("new", "films/my-film", "--template", "smoke")
    assert result.exit_code == 0
    assert result.stdout == "wrote films/my-film.toml; next: pipeline submit films/my-film.toml --preview\n"
    checked = pipeline("check", "films/my-film.toml")
    assert checked.exit_code == 0
    *lines, cost = checked.stdout.splitlines()
    assert lines == [
        "films/my-film.toml: ok",
        "  my-film: 180 frames, 3 s at 60 fps",
        "  393,216 smoke cells",
        '  smoke[0] "plume" as smoke: optical depth 2.5 across its source, density 18.9',
        "  960 x 540 pixels, preview quality",
    ]
    assert "of disk" in cost


def test_new_never_overwrites(in_tmp_path):
    (in_tmp_path / "film.toml").write_text("mine")
    result = pipeline("new", "film")
    assert result.exit_code == 2
    assert result.stderr == "error: film.toml: exists already; choose another name\n"
    assert (in_tmp_path / "film.toml").read_text() == "mine"


def test_new_refuses_a_name_that_no_job_can_have(in_tmp_path):
    result = pipeline("new", "my film")
    assert result.exit_code == 2
    assert result.stderr.startswith('error: "my film": a name holds letters')
    assert list(in_tmp_path.iterdir()) == []


def test_templates_of_the_command_line_are_those_that_exist():
    assert set(TEMPLATES) == set(starter.TEMPLATES)


def test_check_prints_every_problem_on_a_line_of_its_own_and_exits_with_2(in_tmp_path):
    (in_tmp_path / "dam.toml").write_text('name = "dam"\nfps = 0\nframs = 3\n')
    result = pipeline("check", "dam.toml")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.splitlines() == [
        "error: dam.toml:2 fps: must be >= 1, got 0",
        'error: dam.toml:3 frams: unknown key "frams"; did you mean "frames"?',
    ]


def test_check_applies_overrides_and_preview_and_prints_the_whole_job_as_json(in_tmp_path):
    pipeline("new", "film")
    result = pipeline("check", "film.toml", "--preview", "--set", "fps=30", "--json")
    assert result.exit_code == 0
    job = json.loads(result.stdout)
    assert (job["name"], job["fps"], job["render"]["quality"]) == ("film-preview", 30, "draft")


def test_warnings_go_to_the_error_stream(in_tmp_path):
    (in_tmp_path / "still.toml").write_text(
        'name = "still"\n[[rigid]]\nname = "r"\nposition = [0, 0, 0.5]\nshape = { type = "sphere", radius = 0.1 }\n'
    )
    result = pipeline("check", "still.toml")
    assert result.exit_code == 0
    assert (
        result.stderr
        == "warning: still.toml: has no [[fluid]], [[cloth]], [[soft]], [[smoke]] or [[embers]], so nothing will move\n"
    )
    assert result.stdout.startswith("still.toml: ok\n")


def test_schema_is_json():
    assert json.loads(pipeline("schema").stdout)["title"] == "Job file"


def test_a_device_that_this_machine_lacks_is_refused_before_any_work_but_planned(in_tmp_path, monkeypatch):
    devices = {"cpu": "ok", "cuda": "no driver"}
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: devices)
    pipeline("new", "film")
    planned = pipeline("plan", "film.toml", "--set", "device=cuda")
    assert planned.exit_code == 0
    assert "simulate: stale, never made" in planned.stdout
    submitted = pipeline("submit", "film.toml", "--set", "device=cuda")
    assert submitted.exit_code == 3
    assert "Traceback" not in submitted.output
    assert (
        'error: simulate: device "cuda" is not available: no driver; use device = "auto" or "cpu"' in submitted.stderr
    )
    assert not (in_tmp_path / "renders").exists()


@pytest.mark.parametrize(("key", "value"), [("fluid.0.particle_radius", "1e-320"), ("smoke.0.cell_size", "1e300")])
def test_submit_refuses_numbers_that_nothing_can_be_planned_with(in_tmp_path, key, value):
    """In a process of its own: where Taichi has run, numbers like 1e-320 count as zero, and are refused as that."""
    job = PROJECT / "jobs" / "everything.toml"
    refused = subprocess.run(
        [sys.executable, "-m", "pipeline", "submit", str(job), "--set", f"{key}={value}"],
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert refused.returncode == 2
    assert "units are SI" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert [*in_tmp_path.iterdir()] == []


def test_a_job_file_may_not_name_the_program_to_run(in_tmp_path, monkeypatch):
    program = in_tmp_path / "blender"
    program.write_text(f"#!/bin/sh\ntouch {in_tmp_path}/ran\n")
    program.chmod(0o755)
    (in_tmp_path / "film.toml").write_text(f'name = "film"\nframes = 1\n[render]\nblender = "{program}"\n')
    for command in ("submit", "plan", "check"):
        refused = pipeline(command, "film.toml")
        assert refused.exit_code == 2
        assert "render.blender names a program" in refused.stderr
    assert not (in_tmp_path / "ran").exists()
    monkeypatch.setenv("PIPELINE_BLENDER", str(program))
    assert "render.blender names a program" not in pipeline("check", "film.toml").stderr
    monkeypatch.delenv("PIPELINE_BLENDER")
    assert "names a program" not in pipeline("check", "film.toml", "--set", f"render.blender={program}").stderr


@pytest.mark.parametrize("command", ["submit", "status"])
def test_the_shell_completes_names_of_jobs(command, tmp_path):
    for name in ("drop-a", "drop-b", "dam"):
        JobLayout(tmp_path / name).root.mkdir()
        JobLayout(tmp_path / name).manifest.touch()
    (tmp_path / "drop-c").mkdir()  # no job
    arguments = [command, "--farm", str(tmp_path)]
    found = ShellComplete(main, {}, "pipeline", "").get_completions(arguments, "drop")
    assert [each.value for each in found if each.type == "plain"] == ["drop-a", "drop-b"]
