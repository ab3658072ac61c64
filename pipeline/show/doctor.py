"""`pipeline doctor`: does this machine have what a job needs?

Whatever loads foreign code (Blender, OpenVDB, codecs, device drivers) is tried in a child process, so that a crash in
there is a finding. The doctor itself always ends with a report.
"""

import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import psutil
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.base.resources import machine_capacity
from render.system_libraries import DEBIAN_PACKAGES, install_line, missing_libraries

Status = Literal["ok", "warning", "failed"]

PROBE_TIMEOUT_S = 180.0
LITTLE_MEMORY_BYTES = 4e9
LITTLE_DISK_BYTES = 5e9  # the quickstart takes a few hundred MB, a film of a million particles tens of GB

_EXCEPTION_NAME = re.compile(r"^[\w.]+(Error|Exception): ")

_BPY_PROBE = "import bpy; print('Blender', bpy.app.version_string, 'as the bpy module')"
_OPENVDB_PROBE = """
from render.volume import import_openvdb
vdb = import_openvdb()
print('OpenVDB', '.'.join(map(str, vdb.LIBRARY_VERSION)) if hasattr(vdb, 'LIBRARY_VERSION') else '')
"""
_GRAPHS_PROBE = """
from sim.core.cuda_launch import makes_graphs
assert makes_graphs(), 'threads have no folders of their own here'
"""
_THREADS_PROBE = """
from sim.core.runtime import initialize, slow_loops
initialize('cpu')
assert not slow_loops(), slow_loops()
"""
_CODEC_PROBE = """
import av
av.codec.Codec('libx264', 'w')
print('libx264 in PyAV', av.__version__)
"""
_SURFACE_PROBE = """
import pysplashsurf
from importlib.metadata import version
print('pysplashsurf', version('pysplashsurf'))
"""


@dataclass(frozen=True, slots=True)
class Examination:
    """One thing that was looked at."""

    name: str
    status: Status  # warning: some jobs cannot run, or run slowly; failed: no job can run to its end
    detail: str  # what was found
    remedy: str = ""


def examine(output: Path) -> list[Examination]:
    """Look at everything; `output` is the folder that results go to. Takes some seconds."""
    examinations: list[tuple[str, Callable[[], Iterable[Examination]]]] = [
        ("Python", _examine_python),
        ("shared libraries", _examine_shared_libraries),
        ("devices", _examine_devices),
        ("Blender", _examine_blender),
        ("Cycles GPU", _examine_render_gpus),
        ("OpenVDB", lambda: _examine_import("OpenVDB", _OPENVDB_PROBE, "warning", "smoke needs the bpy package")),
        ("surfaces", lambda: _examine_import("surfaces", _SURFACE_PROBE, "failed", _SYNC)),
        ("video", lambda: _examine_import("video", _CODEC_PROBE, "failed", _SYNC)),
        ("processor", _examine_processor),
        ("memory", _examine_memory),
        ("output folder", lambda: _examine_output(output)),
    ]
    with ThreadPoolExecutor(max_workers=4) as pool:
        results = pool.map(lambda item: _guarded(*item), examinations)
    return [each for result in results for each in result]


def print_report(examinations: Iterable[Examination]) -> None:
    """A table for people."""
    marks = {"ok": "[green]ok[/]", "warning": "[yellow]warning[/]", "failed": "[red]failed[/]"}
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for each in examinations:
        remedy = f"\n[bold]→ {escape(each.remedy)}[/]" if each.remedy else ""
        table.add_row(marks[each.status], each.name, escape(each.detail) + remedy)
    Console().print(table)


_SYNC = "run ./run once, which installs requirements.lock; or install the wheel anew"


def _guarded(name: str, look: Callable[[], Iterable[Examination]]) -> list[Examination]:
    """An examination that fails itself is a finding as well: the report must come whatever the machine is like."""
    try:
        return list(look())
    except Exception as error:
        return [Examination(name, "failed", f"could not be examined: {type(error).__name__}: {error}")]


def _examine_python() -> Iterable[Examination]:
    found = f"{platform.python_implementation()} {platform.python_version()} on {platform.platform()}"
    if sys.version_info[:2] in ((3, 11), (3, 13)):
        yield Examination("Python", "ok", found)
    else:
        yield Examination(
            "Python", "warning", f"{found}, for which there is no bpy", "use Python 3.11 or 3.13, or [render] blender"
        )


def _examine_shared_libraries() -> Iterable[Examination]:
    missing = missing_libraries()
    if missing:
        remedy = install_line(DEBIAN_PACKAGES[library] for library in missing)
        yield Examination("shared libraries", "failed", f"missing: {', '.join(missing)}", remedy)
    else:
        yield Examination("shared libraries", "ok", "all that Blender and Taichi link to")


def _examine_devices() -> Iterable[Examination]:
    from sim.core.runtime import available_devices

    for device, answer in available_devices().items():
        if answer == "ok" and device == "cuda":
            with_graphs, reason = _run_child(_GRAPHS_PROBE)
            how = "launched as graphs" if with_graphs else f"launched one by one, which is slower: {reason}"
            yield Examination("device cuda", "ok", f"computes; kernels are {how}")
        elif answer == "ok" and device == "cpu":
            with_own, reason = _run_child(_THREADS_PROBE)
            how = "threads of our own" if with_own else f"Taichi's threads, which is slower: {reason}"
            yield Examination("device cpu", "ok", f"computes; loops have {how}")
        elif answer == "ok":
            yield Examination(f"device {device}", "ok", "computes")
        elif device == "cpu":
            yield Examination("device cpu", "failed", answer, _SYNC)
        else:
            yield Examination(f"device {device}", "ok", f"not used: {answer}")


def _examine_blender() -> Iterable[Examination]:
    succeeded, answer = _run_child(_BPY_PROBE)
    executable = shutil.which("blender")
    if succeeded:
        yield Examination("Blender", "ok", answer)
    elif executable:
        found = f"no bpy module; {executable} is there"
        yield Examination("Blender", "warning", found, f'[render] blender = "{executable}"')
    else:
        remedy = 'install Blender 4.5 or newer and set [render] blender = "/path"'
        yield Examination("Blender", "failed", answer, remedy)


def _examine_render_gpus() -> Iterable[Examination]:
    """What Blender finds now, whatever is remembered."""
    from pipeline.stages.gpu_kernels import kernels_marker
    from render.gpus import find_gpus

    if find_spec("bpy") is None:
        return
    probe = find_gpus(None)
    preferred = probe.of_kind("auto")
    for gpu in probe.gpus:
        kernels = "compiled" if kernels_marker(str(gpu), version("bpy")).exists() else "to be compiled"
        place = f"GPU {preferred.index(gpu)}" if gpu in preferred else f'with render.device = "{gpu.backend.lower()}"'
        yield Examination("Cycles GPU", "ok", f"{gpu}, {place}; kernels {kernels}, if the driver has to")
    if probe.trouble:
        yield Examination("Cycles GPU", "warning", probe.trouble, 'use render.device = "cpu", or look at the driver')
    elif not probe.gpus:
        yield Examination("Cycles GPU", "ok", "none found: frames are drawn on the processor")


def _examine_import(name: str, code: str, otherwise: Status, remedy: str) -> Iterable[Examination]:
    succeeded, answer = _run_child(code)
    yield Examination(name, "ok", answer) if succeeded else Examination(name, otherwise, answer, remedy)


def _examine_processor() -> Iterable[Examination]:
    yield Examination("processor", "ok", f"{machine_capacity().cores} of {os.cpu_count()} cores, {platform.machine()}")


def _examine_memory() -> Iterable[Examination]:
    memory = psutil.virtual_memory()
    found = f"{memory.total / 1e9:.1f} GB, {memory.available / 1e9:.1f} GB of it free"
    if memory.total < LITTLE_MEMORY_BYTES:
        yield Examination("memory", "warning", found, "keep to small jobs, or --preview")
    else:
        yield Examination("memory", "ok", found)


def _examine_output(output: Path) -> Iterable[Examination]:
    folder = next(each for each in (output.absolute(), *output.absolute().parents) if each.exists())
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"written")
            file.flush()
    except OSError as error:
        found = f"{folder} cannot be written: {error.strerror}"
        yield Examination("output folder", "failed", found, "choose another with --farm")
        return
    free = shutil.disk_usage(folder).free
    found = f"{folder}: writable, {free / 1e9:.1f} GB free"
    if free < LITTLE_DISK_BYTES:
        yield Examination("output folder", "warning", found, "free some space, or choose another with --farm")
    else:
        yield Examination("output folder", "ok", found)


def _run_child(code: str) -> tuple[bool, str]:
    """Run Python code in a child process: whether it succeeded, and its last line or what ended it."""
    try:
        child = subprocess.run(
            [sys.executable, "-c", code],
            check=False,
            capture_output=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
            timeout=PROBE_TIMEOUT_S,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(entry or "." for entry in sys.path)},
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {PROBE_TIMEOUT_S:.0f} s"
    if child.returncode < 0:
        return False, f"ends the process with {signal.Signals(-child.returncode).name}"
    if child.returncode == 0:
        return True, child.stdout.strip().rpartition("\n")[2]
    last_line = child.stderr.strip().rpartition("\n")[2]
    return False, _EXCEPTION_NAME.sub("", last_line) or f"exit code {child.returncode}"
