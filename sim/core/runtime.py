"""Start of Taichi, on a device that is known to work; importing this module does not load Taichi.

A driver that is half there can end the process inside `ti.init`, without an exception. So a back end other than the
CPU is first tried in a child process (`python -m sim.core.runtime --probe cuda`), and the answer is remembered.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import io
import json
import os
import platform
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sim.core.parameters import Device

if TYPE_CHECKING:
    from types import ModuleType

PREFERENCE = ("cuda", "metal", "vulkan", "cpu")  # the order in which `auto` takes a device

PROBE_TIMEOUT_S = 120.0
STALE_LOCK_S = 600.0

KEPT_KERNELS_BYTES = 2**30  # Taichi by itself keeps 100 MiB, a few scenes
OK = "ok"
UNTRIED = "it could not be tried: "
"""Begins an answer that is about the environment, as where a package is absent, and not about the device."""

ANSWERED = 3
"""Exit code of a probe that has found why its device does not work; Python's own for any error is 1."""

_in_use: dict[str, Any] = {}
"""Back end and thread count of this process once `initialize` has run; why loops are slow, if they are."""


class DeviceUnavailableError(RuntimeError):
    """The device that was asked for does not work on this machine.

    Attributes:
        device: what was asked for.
        reason: why it does not work.
    """

    def __init__(self, device: str, reason: str) -> None:
        super().__init__(device, reason)
        self.device, self.reason = device, reason

    def __str__(self) -> str:
        remedy = "" if self.device == "cpu" else '; use device = "auto" or "cpu"'
        return f'device "{self.device}" is not available: {self.reason}{remedy}'


def initialize(device: Device = "auto", *, threads: int | None = None, gpu: int | None = None) -> str:
    """Start Taichi on a device and return its back end, such as "cpu"; the only `ti.init` of the project.

    A second call that asks for what runs already (or for "auto") changes nothing. "auto" takes the first of
    `PREFERENCE` that works; threads are all that the process may use if omitted, and results do not depend on them.
    `gpu` is the place of the GPU that CUDA computes on, among those of `cuda_gpus`; other back ends choose themselves.

    Raises:
        DeviceUnavailableError: that device does not work here, or Taichi itself does not load.
        RuntimeError: Taichi runs already on another device or with another number of threads.
    """
    if "device" in _in_use:
        running, its_threads = _in_use["device"], _in_use["threads"]
        if device not in ("auto", running) or threads not in (None, its_threads):
            raise RuntimeError(
                f'Taichi runs on "{running}" with {its_threads} threads in this process already, asked for "{device}" '
                f"with {threads or its_threads}"
            )
        return str(running)
    backend = resolve_device(device)
    thread_count = threads if threads is not None else _usable_cores()
    if backend == "cuda" and gpu and (visible := cuda_gpus()):
        if gpu >= len(visible):
            raise DeviceUnavailableError(backend, f"there is no GPU {gpu}, counted from 0, among {len(visible)}")
        os.environ["CUDA_VISIBLE_DEVICES"] = visible[gpu]  # read when the driver starts, which it does now
    _start_taichi(backend, thread_count)
    _in_use.update(device=backend, threads=thread_count)
    return backend


def slow_loops() -> str:
    """Why Taichi's own threads do the loops of kernels on this CPU, which is slower; empty where ours do."""
    return str(_in_use.get("slow_loops", ""))


def resolve_device(device: Device) -> str:
    """The back end that `initialize` would use for this device, without starting Taichi.

    Raises:
        DeviceUnavailableError: that device does not work here.
    """
    if device == "auto":
        devices = available_devices()
        return next((name for name in PREFERENCE if devices.get(name) == OK), "cpu")
    if device != "cpu":
        reason = available_devices().get(device, "unknown device")
        if reason != OK:
            raise DeviceUnavailableError(device, reason)
    return device


def cuda_gpus() -> list[str]:
    """The CUDA GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them; empty where that is unknown."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name.strip() for name in named.split(",") if name.strip()]
    return [str(place) for place, _ in enumerate(Path("/dev").glob("nvidia[0-9]*"))]


def available_devices() -> dict[str, str]:
    """Every device by name: "ok", or the reason why it does not work on this machine.

    The answers are kept in the user's cache folder until Taichi, the driver or the visible devices change; not where
    one is about the environment, which may be mended without a trace.
    """
    key = _machine_key()
    path = cache_folder() / "devices.json"
    remembered = _read_answers(path, key)
    if remembered is not None:
        return remembered
    answers = _probe_all()
    if any(answer.startswith(UNTRIED) for answer in answers.values()):
        return answers
    # An unwritable cache folder costs the next process a second probe, nothing else.
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}")
        part.write_text(json.dumps({"key": key, "devices": answers}, indent=2))
        part.replace(path)
    return answers


def import_taichi() -> ModuleType:
    """Taichi; raises DeviceUnavailableError where it or a shared library that it needs is absent."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import taichi
    except ImportError as error:
        remedy = "; install it with: apt-get install libx11-6" if "libX11" in str(error) else ""
        raise DeviceUnavailableError("cpu", f"Taichi does not load: {error}{remedy}") from error
    return taichi  # type: ignore[no-any-return]


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _start_taichi(device: str, threads: int) -> None:
    ti = import_taichi()
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

    from sim.core.array_memory import free_in_this_thread

    ASTTransformerContext.get_pos_info = _unwrapped_position
    kernel_cache = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or cache_folder() / "kernels")
    _remove_stale_lock(kernel_cache)
    # Taichi announces its back end with a bare print.
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=getattr(ti, device),
            enable_fallback=False,
            cpu_max_num_threads=threads,
            offline_cache=True,
            offline_cache_file_path=str(kernel_cache),
            offline_cache_max_size_of_files=KEPT_KERNELS_BYTES,
            default_fp=ti.f32,
            default_ip=ti.i32,
            random_seed=0,
        )
    free_in_this_thread()
    if device == "cpu":
        from sim.core.thread_pool import take_over

        try:
            take_over(threads)
        except (OSError, RuntimeError) as reason:
            _in_use["slow_loops"] = str(reason)


def _unwrapped_position(context: Any, node: ast.expr | ast.stmt) -> str:
    """File, line and function of a node of a kernel, its source line, and its part of that line underlined.

    Taichi says so of every expression that it traces, for errors that hardly any of them ever has. Its own wrapping of
    both lines to 80 columns takes as long as all the rest of the tracing.
    """
    line = context.src[node.lineno - 1].rstrip()
    start = context.indent + node.col_offset
    one_line = node.end_lineno == node.lineno and node.end_col_offset is not None
    end = context.indent + (node.end_col_offset or 0) if one_line else len(line)
    place = f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:'
    return f"{place}\n{line}\n{' ' * start}{'^' * (end - start)}\n"


def _remove_stale_lock(kernel_cache: Path) -> None:
    """Remove the lock of a process that was killed while it wrote: with it no kernel would be kept any more."""
    for lock in kernel_cache.glob("**/*.lock"):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - lock.stat().st_mtime > STALE_LOCK_S:
                lock.unlink()


def cache_folder() -> Path:
    """Of kernels and devices; a relative XDG_CACHE_HOME counts as none, as its specification has it."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "physics-pipeline"


def _machine_key() -> str:
    """Digest of all that decides which devices work, from files and environment alone."""
    facts = [version("taichi"), platform.python_version(), platform.platform(), platform.node()]
    facts += [
        os.environ.get(name, "") for name in ("CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "VK_ICD_FILENAMES")
    ]
    nvidia_driver = Path("/proc/driver/nvidia/version")
    if nvidia_driver.exists():
        facts.append(nvidia_driver.read_text())
    facts += sorted(str(path) for pattern in ("nvidia*", "dri/*") for path in Path("/dev").glob(pattern))
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()


def _read_answers(path: Path, key: str) -> dict[str, str] | None:
    """The remembered answers, or None where there are none for this machine as it is now."""
    try:
        remembered = json.loads(path.read_text())
        if remembered["key"] == key:
            return {str(name): str(answer) for name, answer in remembered["devices"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return None


def _probe_all() -> dict[str, str]:
    answers = {name: _reason_without_probe(name) for name in PREFERENCE}
    children = {name: _start_probe(name) for name, reason in answers.items() if reason is None}
    return {name: reason or _read_probe(children[name]) for name, reason in answers.items()}


def _reason_without_probe(device: str) -> str | None:
    """Why a device cannot work, as far as the operating system alone can tell."""
    if device == "metal" and sys.platform != "darwin":
        return "Metal exists on macOS only"
    if device == "cuda" and sys.platform == "darwin":
        return "CUDA does not exist on macOS"
    # Software Vulkan answers a probe as well, and is far slower than the CPU back end.
    if device == "vulkan" and sys.platform == "linux" and not list(Path("/dev").glob("dri/renderD*")):
        return "no GPU for Vulkan: there is no /dev/dri/renderD*"
    return None


def _start_probe(device: str) -> subprocess.Popen[str]:
    root = str(Path(__file__).resolve().parents[2])
    search_path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", "sim.core.runtime", "--probe", device],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": search_path},
    )


def _read_probe(child: subprocess.Popen[str]) -> str:
    try:
        answer, complaint = child.communicate(timeout=PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.communicate()
        return f"its driver does not answer within {PROBE_TIMEOUT_S:.0f} s"
    if child.returncode == 0:
        return OK
    if child.returncode < 0:
        return f"its driver ends the process with {signal.Signals(-child.returncode).name}"
    lines = (answer.strip() or complaint.strip() or f"the probe ended with {child.returncode}").splitlines()
    if child.returncode != ANSWERED:
        return f"{UNTRIED}{lines[-1]}"
    # Taichi's own words for a missing driver library are "Arch=[<Arch.cuda: 3>] is not supported".
    return "no driver for it was found" if "is not supported" in lines[-1] else lines[-1]


def _probe(device: str) -> None:
    """Start the device and compute something on it, in this process."""
    _start_taichi(device, 1)
    import numpy as np

    from sim.core.reductions import sum_integers

    numbers = import_taichi().ndarray(int, 1000)
    numbers.from_numpy(np.arange(1000, dtype=np.int32))
    result = sum_integers(numbers)
    if result != 499500:
        raise DeviceUnavailableError(device, f"it computes wrongly: a sum is {result}, not 499500")


def main() -> int:
    """Entry of the child process that tries one device; prints the reason where it does not work."""
    parser = argparse.ArgumentParser(description="Try one device in this process.")
    parser.add_argument("--probe", choices=[name for name in get_args(Device) if name != "auto"], required=True)
    arguments = parser.parse_args()
    try:
        _probe(arguments.probe)
    # Whatever a driver raises is the answer; a package or a library that does not load says nothing of the device.
    except Exception as error:
        reason = error.reason if isinstance(error, DeviceUnavailableError) else str(error) or type(error).__name__
        sys.stdout.write(f"{reason.strip().splitlines()[0]}\n")
        return 1 if isinstance(error, ImportError) or isinstance(error.__cause__, ImportError) else ANSWERED
    return 0


if __name__ == "__main__":
    sys.exit(main())
