"""A job has to fit into the memory of what computes it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from checked_jobs import says
from places import PROJECT

from pipeline.kinds.checks import memory_budget as module
from pipeline.kinds.checks.memory_budget import SHARE, free_gpu_bytes, memory_budget
from pipeline.model.job import Job
from pipeline.run.checked_job import check_job
from sim.core.domain import DomainParameters

WATER = {"name": "water", "block": [{"shape": {"type": "box", "size": (0.4, 0.4, 0.4)}, "position": (0.0, 0.0, 0.5)}]}


def job(device: str = "cuda", **water: object) -> Job:
    return Job.model_validate({"name": "a", "frames": 2, "device": device, "fluid": [{**WATER, **water}]}, strict=False)


@pytest.fixture
def small_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU that works and has 4 MB left."""
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    monkeypatch.setattr(module, "free_gpu_bytes", lambda: 4_000_000)


def errors(of: Job) -> list[str]:
    return [problem.message for problem in check_job(of).errors]


@pytest.mark.usefixtures("small_gpu")
def test_a_fluid_has_to_fit_into_the_gpu_that_computes_it():
    (error,) = errors(job())
    # 0.4 m / 0.02 m = 20 particles an edge; 3.6 MB of 600 bytes each
    assert says(error, "8000 particles need 0.0048 GB, the GPU has 0.0036 GB; at most 6000 fit: use 0.012 m")
    assert errors(job(particle_radius=0.012)) == []
    assert errors(job("cpu")) == []


@pytest.mark.usefixtures("small_gpu")
def test_a_wider_support_takes_more_memory():
    assert errors(job(particle_radius=0.0125)) == []
    (error,) = errors(job(particle_radius=0.0125, support_in_spacings=4.0))
    assert "the GPU has" in error


def test_where_no_gpu_tells_its_memory_the_machines_counts(monkeypatch):
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    monkeypatch.setattr(module, "free_gpu_bytes", lambda: None)
    assert memory_budget(job()).owner == "this machine"
    assert memory_budget(job()).bytes > 0


def test_a_device_that_does_not_work_here_is_for_others_to_refuse(monkeypatch):
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "no driver"})
    assert memory_budget(job()).owner == "this machine"


def test_the_driver_is_asked_and_may_be_missing(monkeypatch):
    free = free_gpu_bytes()
    assert free is None or 0 < SHARE * free < 1e13
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert free_gpu_bytes() is None


DRIVER = """
#include <string.h>
typedef struct { unsigned long long total, free, used; } memory_t;   /* nvmlMemory_t of nvml.h */
static int users = 0;
static int devices[3] = {0, 1, 2};
int nvmlInit_v2(void) { users++; return 0; }
int nvmlShutdown(void) { users--; return 0; }
int nvmlDeviceGetHandleByIndex_v2(unsigned int index, void **device) {
    if (index > 2) return 2;
    *device = &devices[index];
    return 0;
}
int nvmlDeviceGetHandleByUUID(const char *uuid, void **device) {
    if (strcmp(uuid, "GPU-7") != 0) return 6;
    *device = &devices[1];
    return 0;
}
int nvmlDeviceGetMemoryInfo(void *device, memory_t *memory) {
    static const unsigned long long free_bytes[2] = {149250000000ULL, 4000000ULL};
    int index = *(int *)device;
    if (users != 1 || index > 1) return 3;                           /* the third device answers nothing */
    memory->total = 150000000000ULL;
    memory->free = free_bytes[index];
    memory->used = memory->total - memory->free;
    return 0;
}
"""
"""Of the functions of Nvidia's management library those that are asked, for three GPUs, with their real signatures."""


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a library that answers as a driver would."""
    folder = tmp_path_factory.mktemp("driver")
    (folder / "nvml.c").write_text(DRIVER)
    command = ["cc", "-shared", "-fPIC", "-o", folder / "libnvidia-ml.so.1", folder / "nvml.c"]
    subprocess.run(command, check=True)
    return folder


def with_driver(driver: Path, code: str, **environment: str) -> str:
    """Run code in a process that finds this driver; what it prints."""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "LD_LIBRARY_PATH": str(driver), "PYTHONPATH": str(PROJECT), **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return ended.stdout.strip()


needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@needs_compiler
@pytest.mark.parametrize(
    ("visible", "free"),
    [
        (None, "149250000000"),
        ("0,1", "149250000000"),
        ("1,0", "4000000"),
        ("GPU-7", "4000000"),
        ("GPU-8", "None"),
        ("2", "None"),
        ("9", "None"),
    ],
)
def test_the_driver_tells_the_free_memory_of_the_first_visible_gpu(driver, visible, free):
    asked = "from pipeline.kinds.checks.memory_budget import free_gpu_bytes as f; print(f(), f())"
    environment = {} if visible is None else {"CUDA_VISIBLE_DEVICES": visible}
    # Twice: every question has to end what it began.
    assert with_driver(driver, asked, **environment) == f"{free} {free}"


def test_a_job_too_large_for_a_large_gpu_is_refused_with_the_count_that_fits(monkeypatch):
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok", "cuda": "ok"})
    monkeypatch.setattr(module, "free_gpu_bytes", lambda: 149_250_000_000)

    def of_size(size: float) -> Job:
        box = {"shape": {"type": "box", "size": (size,) * 3}, "position": (0.0, 0.0, size / 2.0)}
        domain = {"min": (-size, -size, 0.0), "max": (size, size, 2.0 * size)}
        return job(particle_radius=0.005, block=[box]).model_copy(update={"domain": DomainParameters(**domain)})

    # 90 % of 149.25 GB are 134.3 GB, and 223.9 million particles of 600 bytes: a cube of 607 an edge.
    assert errors(of_size(6.0)) == []
    (refused,) = errors(of_size(6.1))
    assert says(refused, "227 million particles need 136 GB ... 134 GB; at most 224 million fit: use 0.0051 m")


def test_a_fluid_of_emitters_alone_has_a_time_step_to_check():
    emitter = {"shape": {"type": "disc", "radius": 0.05}, "position": (0.0, 0.0, 0.8), "direction": (0.0, 0.0, -1.0)}
    findings = check_job(job("cpu", block=(), emitter=[{**emitter, "speed": 2.0}], dt=0.1))
    assert any("0.1 s is above the stable step" in warning.message for warning in findings.warnings)
