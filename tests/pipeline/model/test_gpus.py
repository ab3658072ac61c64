"""The GPUs that pictures are drawn on: what Blender tells of them, what is remembered, and what jobs make of it."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from needed_blender import needs_bpy

from pipeline.base import wording
from pipeline.base.layout import JobLayout
from pipeline.job.loading import job_of_text
from pipeline.model import gpus
from pipeline.model.gpus import known_gpus, render_trouble, usable_gpus
from pipeline.model.job import Job
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.render import RenderStage
from render.gpus import Gpu, Probe, find_gpus, read_answer

CARDS = tuple(Gpu("OPTIX", "NVIDIA H100", f"CUDA_H100_0000:{slot}_OptiX") for slot in ("1b", "43"))
ALL = (*CARDS, *(Gpu("CUDA", gpu.name, gpu.id.removesuffix("_OptiX")) for gpu in CARDS))
JOB = """
name = "plume"
device = "cpu"
frames = 2
render.device = "{device}"

[[smoke]]
name = "plume"
source = [{{ shape = {{ type = "sphere", radius = 0.1 }}, position = [0.0, 0.0, 0.2] }}]
"""


def job(device: str) -> Job:
    return job_of_text(JOB.format(device=device), Path("job.toml"))


class Machine:
    """What Blender would answer on another machine, and how often it was asked."""

    def __init__(self) -> None:
        self.probe = Probe(ALL)
        self.asked = 0

    def find_gpus(self, _blender: str | None) -> Probe:
        self.asked += 1
        return self.probe


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in (gpus.OWN_GPUS, *gpus._VISIBILITY):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pipeline.model.gpus.find_gpus", machine.find_gpus)
    monkeypatch.setattr(gpus, "_device_files", lambda: ["/dev/nvidia0", "/dev/nvidia1"])
    monkeypatch.setattr(gpus, "driver_version", lambda: "570.1")
    start_anew()
    return machine


def start_anew() -> None:
    """As another process, which knows only what is in the cache folder."""
    gpus._answer.cache_clear()


def gpus_a_frame(device: str) -> set[int]:
    tasks = plan_job(job(device), JobLayout(Path("renders/plume")), STAGES)
    return {task.resources.gpus for task in tasks if task.stage == "render"}


@needs_bpy
def test_blender_is_asked_in_a_process_of_its_own_and_tells_all_that_it_finds():
    probe = find_gpus(None)
    assert probe.trouble == ""
    assert all(gpu.backend in ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL") and gpu.name for gpu in probe.gpus)


def blender(folder: Path, *lines: str, gpus: Sequence[Gpu] = CARDS) -> str:
    """A program that tells of GPUs as Blender does, and then does what further lines say."""
    path = folder / "blender"
    devices = [{"name": gpu.name, "id": gpu.id} for gpu in gpus]
    told = json.dumps({"backend": gpus[0].backend, "devices": devices}, ensure_ascii=False)
    path.write_bytes("\n".join(["#!/bin/sh", f"echo 'GPUS {told}'", *lines, ""]).encode("utf-8", "surrogateescape"))
    path.chmod(0o755)
    return str(path)


def test_what_was_told_before_a_driver_ended_blender_counts_and_the_end_is_told(tmp_path):
    probe = find_gpus(blender(tmp_path, "kill -SEGV $$"))
    assert probe.gpus == CARDS
    assert probe.trouble.startswith("Blender ended with exit code -11 while it looked for GPUs")


def test_what_was_told_before_a_driver_hung_counts_and_the_hang_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("render.gpus.PROBE_TIMEOUT_S", 1.0)
    told = find_gpus(blender(tmp_path, "exec sleep 60"))
    assert told == Probe(CARDS, "Blender took more than 1 s to look for GPUs")


def test_names_of_drivers_and_files_in_any_encoding_are_read(tmp_path):
    card = Gpu("HIP", "Vidéo", "0")
    lines = ("echo 'cannot open M\udcfcller.so'", "echo GPUS_DONE\\ 5.0.1")
    assert find_gpus(blender(tmp_path, *lines, gpus=[card])) == Probe((card,))


def test_lines_of_blender_itself_tell_of_no_gpu():
    assert read_answer(["Color management: warning", 'GPUS {"backend": "HIP", "devices": []}', "GPUS_DONE 5.0.1"]) == ()


@pytest.mark.parametrize(
    ("device", "found"),
    [
        *(("auto", CARDS), ("gpu", CARDS), ("optix", CARDS), ("cuda", ALL[2:])),
        *(("hip", ()), ("oneapi", ()), ("metal", ()), ("cpu", ())),
    ],
)
def test_a_device_means_gpus_of_one_back_end_the_preferred_one_where_it_is_left_open(device, found):
    assert Probe(ALL).of_kind(device) == found
    assert Probe().of_kind(device) == ()


def test_the_answer_is_remembered_until_driver_or_visible_devices_change(machine, monkeypatch):
    for _ in range(2):
        start_anew()
        assert known_gpus(None) == Probe(ALL)
    assert machine.asked == 1
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    assert known_gpus(None) == Probe(ALL)
    monkeypatch.setattr(gpus, "driver_version", lambda: "580.65")
    assert known_gpus(None) == Probe(ALL)
    assert machine.asked == 3


def test_an_answer_that_was_cut_short_is_remembered_for_an_hour(machine, tmp_path):
    cut_short = machine.probe = Probe(CARDS, trouble="Blender took more than 120 s to look for GPUs")
    for _ in range(2):
        start_anew()
        assert known_gpus(None) == cut_short
    assert machine.asked == 1
    machine.probe = Probe(ALL)
    path = tmp_path / "physics-pipeline" / "render-gpus.json"
    remembered = json.loads(path.read_text())
    path.write_text(json.dumps(remembered | {"asked_at": remembered["asked_at"] - gpus.TROUBLE_KEPT_S}))
    start_anew()
    assert known_gpus(None) == Probe(ALL)


@pytest.mark.parametrize("spoilt", ["", "[]", '{"key": 1}', '{"key": "KEY", "gpus": [{"name": "H100"}]}'])
def test_a_spoilt_cache_is_looked_past(machine, tmp_path, spoilt):
    path = tmp_path / "physics-pipeline" / "render-gpus.json"
    path.parent.mkdir()
    path.write_text(spoilt.replace("KEY", gpus._key(None)))
    assert known_gpus(None) == Probe(ALL)
    assert machine.asked == 1


@pytest.mark.skipif("sys.platform != 'linux'", reason="device files are Linux's")
def test_without_device_files_nobody_is_asked(machine, monkeypatch):
    monkeypatch.setattr(gpus, "_device_files", list)
    assert known_gpus(None) == Probe()
    assert machine.asked == 0


def test_a_frame_takes_a_gpu_where_there_is_one_or_where_the_job_names_one(machine):
    assert [gpus_a_frame(device) for device in ("cpu", "auto", "gpu", "hip")] == [{0}, {1}, {1}, {1}]
    machine.probe = Probe()
    start_anew()
    (machine_file,) = Path(gpus.cache_folder()).iterdir()
    machine_file.unlink()
    assert [gpus_a_frame(device) for device in ("cpu", "auto", "gpu", "hip")] == [{0}, {0}, {1}, {1}]


def test_nobody_asks_for_gpus_where_the_job_leaves_no_choice(machine):
    for device in ("cpu", "gpu", "optix"):
        gpus_a_frame(device)
    assert machine.asked == 0


def test_gpus_change_no_fingerprint(machine):
    def parameters() -> set[str]:
        tasks = plan_job(job("auto"), JobLayout(Path("renders/plume")), STAGES)
        return {task.parameters.digest for task in tasks}

    with_gpus = parameters()
    machine.probe = Probe()
    gpus.cache_folder().joinpath("render-gpus.json").unlink()
    start_anew()
    assert parameters() == with_gpus


def test_a_process_uses_those_gpus_only_that_are_left_to_it(machine, monkeypatch):
    assert usable_gpus(job("auto")) == CARDS
    monkeypatch.setenv(gpus.OWN_GPUS, "1,5")
    assert usable_gpus(job("auto")) == CARDS[1:]
    monkeypatch.setenv(gpus.OWN_GPUS, "")
    assert usable_gpus(job("auto")) == ()
    assert [gpus_a_frame(device) for device in ("cpu", "auto", "gpu")] == [{0}, {0}, {1}]


@pytest.mark.parametrize(
    ("probe", "own", "device", "sentence"),
    [
        (Probe(ALL), "1,5", "auto", "PIPELINE_GPUS names GPU 5, but Cycles finds only the GPUs 0 to 1 here"),
        (Probe(ALL), "1,5", "gpu", "PIPELINE_GPUS names GPU 5, but Cycles finds only the GPUs 0 to 1 here"),
        (Probe(ALL), "1,5", "cpu", None),
        (Probe(ALL), "1", "optix", None),
        (Probe(ALL), "", "auto", None),
        (Probe(ALL), "", "gpu", 'render.device is "gpu", but PIPELINE_GPUS leaves this process no GPU; use '),
        (Probe(ALL), None, "cuda", None),
        (Probe(), None, "gpu", 'render.device is "gpu", but Cycles finds no GPU here; use "auto" or "cpu"'),
        (Probe(), None, "auto", None),
        (Probe(), None, "cpu", None),
        (Probe(CARDS[:1]), None, "hip", "but Cycles finds only NVIDIA H100 (optix) here; use "),
        (Probe(trouble="Blender crashed"), None, "gpu", "but Cycles finds no GPU here (Blender crashed); use "),
    ],
)
@needs_bpy
def test_a_gpu_that_is_asked_for_and_not_there_stops_a_job_before_any_work(
    machine, monkeypatch, probe, own, device, sentence
):
    machine.probe = probe
    if own is not None:
        monkeypatch.setenv(gpus.OWN_GPUS, own)
    told = RenderStage().preflight(job(device))
    assert told == [] if sentence is None else len(told) == 1 and sentence in told[0]


@needs_bpy
def test_a_machine_without_gpus_draws_on_the_processor_whatever_place_is_left_to_it(machine, monkeypatch):
    machine.probe = Probe()
    monkeypatch.setenv(gpus.OWN_GPUS, "0")
    assert RenderStage().preflight(job("auto")) == []
    assert gpus_a_frame("auto") == {0}


def test_that_gpus_cannot_be_told_is_said_of_a_job_that_would_take_them(machine):
    machine.probe = Probe(trouble="Blender crashed")
    assert [render_trouble(job(device)) for device in ("auto", "cpu")] == ["Blender crashed", ""]
    start_anew()
    gpus.cache_folder().joinpath("render-gpus.json").unlink()
    machine.probe = Probe(CARDS, trouble="another driver crashed")
    assert render_trouble(job("auto")) == ""


def test_a_film_of_several_devices_is_warned_of():
    assert wording.mixed_devices({}) == wording.mixed_devices({"CPU": 60}) == []
    (sentence,) = wording.mixed_devices({"CPU": 40, "OPTIX: NVIDIA H100": 20})
    assert "round differently: 40 on CPU, 20 on OPTIX: NVIDIA H100;" in sentence
