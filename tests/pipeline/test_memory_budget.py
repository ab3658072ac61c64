"""A job has to fit into the memory of what computes it."""

from __future__ import annotations

import pytest

from pipeline.job import memory_budget as module
from pipeline.job.checks import check_job
from pipeline.job.memory_budget import SHARE, free_gpu_bytes, memory_budget
from pipeline.job.models import Job

WATER = {"name": "water", "block": [{"shape": {"type": "box", "size": (0.4, 0.4, 0.4)}, "position": (0.0, 0.0, 0.5)}]}


def job(device: str = "cuda", **water: object) -> Job:
    return Job.model_validate({"name": "a", "frames": 2, "device": device, "fluid": [{**WATER, **water}]}, strict=False)


@pytest.fixture
def small_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU that works and has 4 MB left."""
    monkeypatch.setattr("sim.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    monkeypatch.setattr(module, "free_gpu_bytes", lambda: 4_000_000)


def errors(of: Job) -> list[str]:
    return [problem.message for problem in check_job(of).errors]


@pytest.mark.usefixtures("small_gpu")
def test_a_fluid_has_to_fit_into_the_gpu_that_computes_it():
    (error,) = errors(job())
    # 0.4 m / 0.02 m = 20 particles an edge; 3.6 MB of 600 bytes each
    assert "8000 particles need 0.0048 GB, the GPU has 0.0036 GB; at most 6000 fit: use 0.012 m or more" in error
    assert errors(job(particle_radius=0.012)) == []
    assert errors(job("cpu")) == []


@pytest.mark.usefixtures("small_gpu")
def test_a_wider_support_takes_more_memory():
    assert errors(job(particle_radius=0.0125)) == []
    (error,) = errors(job(particle_radius=0.0125, support_in_spacings=4.0))
    assert "the GPU has" in error


def test_where_no_gpu_tells_its_memory_the_machines_counts(monkeypatch):
    monkeypatch.setattr("sim.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    monkeypatch.setattr(module, "free_gpu_bytes", lambda: None)
    assert memory_budget(job()).owner == "this machine"
    assert memory_budget(job()).bytes > 0


def test_a_device_that_does_not_work_here_is_for_others_to_refuse(monkeypatch):
    monkeypatch.setattr("sim.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "no driver"})
    assert memory_budget(job()).owner == "this machine"


def test_the_driver_is_asked_and_may_be_missing(monkeypatch):
    free = free_gpu_bytes()
    assert free is None or 0 < SHARE * free < 1e13
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert free_gpu_bytes() is None


def test_a_fluid_of_emitters_alone_has_a_time_step_to_check():
    emitter = {"shape": {"type": "disc", "radius": 0.05}, "position": (0.0, 0.0, 0.8), "direction": (0.0, 0.0, -1.0)}
    findings = check_job(job("cpu", block=(), emitter=[{**emitter, "speed": 2.0}], dt=0.1))
    assert any("0.1 s is above the stable step" in warning.message for warning in findings.warnings)
