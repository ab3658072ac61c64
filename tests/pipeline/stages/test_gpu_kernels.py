"""Cycles' kernels are compiled by one renderer while the others wait, whoever dies."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from places import HELPERS

from pipeline.stages.gpu_kernels import compiled_once, kernels_marker

CARD = "OPTIX: NVIDIA RTX 4090"
COMPILING = "told compiling Cycles' kernels for NVIDIA RTX 4090; minutes, once"
WAITING = "told another renderer is compiling Cycles' kernels for NVIDIA RTX 4090; waiting for it"

Renderer = subprocess.Popen[str]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def start(cache: Path) -> Iterator[Callable[..., Renderer]]:
    processes: list[Renderer] = []

    def start(device: str = CARD) -> Renderer:
        path = os.pathsep.join(entry or "." for entry in sys.path)
        process = subprocess.Popen(
            [sys.executable, str(HELPERS / "held_kernels.py"), device],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(cache)},
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def said(process: Renderer) -> str:
    assert process.stdout is not None
    return process.stdout.readline().rstrip("\n")


def tell(process: Renderer, line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


def test_one_compiles_and_says_so_while_another_waits_and_then_finds_it_done(start):
    first = start()
    assert [said(first), said(first)] == [COMPILING, "in"]
    second = start()
    assert said(second) == WAITING
    tell(first, "drawn")
    assert said(first) == "out"
    assert [said(second), said(second)] == ["told", "in"]


def test_after_one_that_died_or_failed_the_next_compiles(start):
    first, second, third = start(), None, None
    assert [said(first), said(first)] == [COMPILING, "in"]
    second = start()
    assert said(second) == WAITING
    first.kill()
    assert [said(second), said(second)] == [COMPILING, "in"]
    third = start()
    assert said(third) == WAITING
    tell(second, "fail")
    assert [said(third), said(third)] == [COMPILING, "in"]


def test_another_kind_of_gpu_waits_for_nobody(start):
    first, other = start(), start("OPTIX: NVIDIA A100")
    assert [said(first), said(first)] == [COMPILING, "in"]
    assert [said(other), said(other)] == [COMPILING.replace("RTX 4090", "A100"), "in"]


def test_those_who_come_after_are_kept_by_nobody(start):
    marker = kernels_marker(CARD, "5.0.1")
    marker.parent.mkdir(parents=True)
    marker.touch()
    first, second = start(), start()
    for process in (first, second):
        assert [said(process), said(process)] == ["told", "in"]


def test_kernels_count_for_one_blender_device_driver_and_machine(monkeypatch):
    markers = [kernels_marker(CARD, "5.0.1"), kernels_marker(CARD, "5.1.0")]
    markers.append(kernels_marker("CUDA: NVIDIA RTX 4090", "5.0.1"))
    monkeypatch.setattr("pipeline.stages.gpu_kernels.driver_version", lambda: "580.65")
    markers.append(kernels_marker(CARD, "5.0.1"))
    monkeypatch.setattr("platform.node", lambda: "another")
    markers.append(kernels_marker(CARD, "5.0.1"))
    assert len(set(markers)) == 5


def test_a_cache_folder_that_cannot_be_written_keeps_nobody_from_drawing(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    told: list[str] = []
    with compiled_once(CARD, "5.0.1", told.append):
        pass
    assert told == [COMPILING.removeprefix("told ")]
