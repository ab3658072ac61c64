"""The doctor: on this machine, and where something is missing or crashes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import pipeline

from pipeline.show import doctor
from pipeline.show.doctor import Examination, examine, print_report
from render.system_libraries import DEBIAN_PACKAGES, install_line, missing_libraries
from sim.core import runtime
from sim.core.cuda_launch import makes_graphs


@pytest.mark.slow
def test_this_machine_is_fit_and_the_report_is_json(tmp_path):
    result = pipeline("doctor", "--json", "--farm", tmp_path / "renders")
    report = {each["name"]: each for each in json.loads(result.stdout)}
    assert {"Python", "shared libraries", "device cpu", "Blender", "OpenVDB", "video", "output folder"} <= set(report)
    assert report["device cpu"]["status"] == "ok"
    assert report["video"]["status"] == "ok"
    assert result.exit_code == int(any(each["status"] == "failed" for each in report.values()))
    assert not (tmp_path / "renders").exists()


def test_an_examination_that_raises_becomes_a_finding_and_the_others_still_come(tmp_path, monkeypatch):
    def broken() -> list[Examination]:
        raise RuntimeError("no such register")

    monkeypatch.setattr(doctor, "_examine_memory", broken)
    for slow in ("_BPY_PROBE", "_OPENVDB_PROBE", "_CODEC_PROBE", "_SURFACE_PROBE"):
        monkeypatch.setattr(doctor, slow, "print('there')")
    report = {each.name: each for each in examine(tmp_path)}
    assert report["memory"].status == "failed"
    assert report["memory"].detail == "could not be examined: RuntimeError: no such register"
    assert report["processor"].status == "ok"


@pytest.mark.parametrize(
    ("code", "succeeded", "answer"),
    [
        ("print('Blender 9')", True, "Blender 9"),
        ("import os; os.kill(os.getpid(), 11)", False, "ends the process with SIGSEGV"),
        ("import no_such_module", False, "No module named 'no_such_module'"),
        ("raise SystemExit(3)", False, "exit code 3"),
    ],
)
def test_what_happens_in_a_child_is_told_in_a_line(code, succeeded, answer):
    assert doctor._run_child(code) == (succeeded, answer)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission_is_a_failure(tmp_path):
    tmp_path.chmod(0o500)
    [finding] = doctor._examine_output(tmp_path / "renders")
    assert finding.status == "failed"
    assert "cannot be written" in finding.detail


def test_pseudo_folder_that_nobody_can_write_is_a_failure():
    [finding] = doctor._examine_output(Path("/proc/renders"))
    assert finding.status == "failed"
    assert finding.detail.startswith("/proc cannot be written: ")


def test_table_for_people_holds_every_finding(capsys):
    print_report([Examination("disk", "failed", "full [very]", "delete"), Examination("cpu", "ok", "computes")])
    table = capsys.readouterr().out
    for word in ("failed", "disk", "full [very]", "delete", "cpu", "computes"):
        assert word in table


@pytest.mark.parametrize("refused", [False, True])
def test_a_device_whose_kernels_are_launched_one_by_one_is_told(monkeypatch, refused):
    monkeypatch.setattr(runtime, "available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    if refused:
        probe = doctor._GRAPHS_PROBE.replace("assert", "makes_graphs = lambda: False\nassert", 1)
        monkeypatch.setattr(doctor, "_GRAPHS_PROBE", probe)
    cuda = next(each for each in doctor._examine_devices() if each.name == "device cuda")
    with_graphs = makes_graphs() and not refused
    assert cuda.status == "ok"
    assert ("as graphs" in cuda.detail, "slower: threads" in cuda.detail) == (with_graphs, not with_graphs)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="libraries of Linux")
def test_missing_libraries_are_named_with_their_packages():
    assert missing_libraries(["libc.so.6", "libno-such-thing.so.1"]) == ["libno-such-thing.so.1"]
    assert install_line(["libx11-6", "libsm6"]) == "sudo apt-get install -y libx11-6 libsm6"


def test_library_check_prints_packages_only_and_loads_nothing_but_the_standard_library():
    code = (
        "import sys, runpy; runpy.run_module('render.system_libraries', run_name='__main__'); "
        "assert not {'click', 'numpy', 'pydantic'} & set(sys.modules)"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(child.stdout.split()) <= set(DEBIAN_PACKAGES.values())
