import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fresh_python import run_python
from places import PROJECT

from sim.core import runtime
from sim.core.runtime import DeviceUnavailableError, available_devices, initialize, resolve_device


def test_second_initialization_on_the_same_device_changes_nothing(taichi_cpu):
    assert initialize("cpu") == "cpu"
    assert initialize("auto") == "cpu"


@pytest.mark.parametrize(("device", "threads"), [("vulkan", None), ("cpu", 977)])
def test_second_initialization_with_something_else_is_refused(taichi_cpu, device, threads):
    with pytest.raises(RuntimeError, match=r'runs on "cpu" with .* threads in this process already'):
        initialize(device, threads=threads)


def test_importing_runtime_does_not_load_taichi_and_starting_it_prints_nothing():
    code = """
    import sys, sim.core.runtime
    assert "taichi" not in sys.modules
    sys.stderr = sys.stdout
    sim.core.runtime.initialize("cpu")
    """
    assert run_python(code) == ""


def test_probe_answers_by_exit_code():
    assert runtime._read_probe(runtime._start_probe("cpu")) == "ok"


def test_probe_that_crashes_names_the_signal():
    child = subprocess.Popen(
        [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert runtime._read_probe(child) == "its driver ends the process with SIGSEGV"


def test_devices_are_remembered_until_the_machine_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = tmp_path / "physics-pipeline" / "devices.json"
    path.parent.mkdir()
    answers = {"cuda": "from an earlier probe", "cpu": "ok"}
    path.write_text(json.dumps({"key": runtime._machine_key(), "devices": answers}))
    assert available_devices() == answers
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "none of them")
    monkeypatch.setattr(runtime, "_probe_all", lambda: {"cpu": "probed again"})
    assert available_devices() == {"cpu": "probed again"}
    assert available_devices() == {"cpu": "probed again"}


def test_what_the_environment_lacks_is_told_and_not_remembered(tmp_path, monkeypatch):
    """A machine whose environment was mended asks its devices again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(runtime, "_reason_without_probe", lambda name: None if name == "cuda" else "not looked at")
    package = tmp_path / "broken" / "taichi" / "__init__.py"
    package.parent.mkdir(parents=True)
    package.write_text("import no_such_module")
    monkeypatch.setenv("PYTHONPATH", str(package.parents[1]))
    assert available_devices()["cuda"] == (
        "it could not be tried: Taichi does not load: No module named 'no_such_module'"
    )
    monkeypatch.setattr(runtime, "_probe_all", lambda: {"cuda": "ok"})
    assert available_devices() == {"cuda": "ok"}


def test_probe_that_cannot_even_start_says_nothing_of_the_device():
    child = subprocess.Popen(
        [sys.executable, "-m", "no_such_module"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert runtime._read_probe(child).startswith(runtime.UNTRIED)


@pytest.mark.parametrize(("named", "base"), [("/elsewhere", "/elsewhere"), ("beside", "~/.cache"), ("", "~/.cache")])
def test_a_relative_cache_home_counts_as_none(monkeypatch, named, base):
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    assert runtime.cache_folder() == Path(base).expanduser() / "physics-pipeline"


@pytest.mark.parametrize("content", ["", "{", "[]", '{"key": 1}'])
def test_unreadable_memory_of_devices_counts_as_none(tmp_path, content):
    path = tmp_path / "devices.json"
    path.write_text(content)
    assert runtime._read_answers(path, "key") is None


def test_device_that_does_not_work_is_refused_with_its_reason_and_not_taken_by_auto(monkeypatch):
    monkeypatch.setattr(runtime, "available_devices", lambda: {"cuda": "no driver", "cpu": "ok"})
    with pytest.raises(
        DeviceUnavailableError, match='"cuda" is not available: no driver; use device = "auto" or "cpu"'
    ):
        resolve_device("cuda")
    assert resolve_device("auto") == "cpu"


def test_missing_x11_library_is_named_with_the_remedy(monkeypatch):
    class Refuse:
        def find_spec(self, name, *_):
            if name == "taichi":
                raise ImportError("libX11.so.6: cannot open shared object file: No such file or directory")

    monkeypatch.delitem(sys.modules, "taichi", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Refuse(), *sys.meta_path])
    with pytest.raises(DeviceUnavailableError, match="install it with: apt-get install libx11-6"):
        runtime.import_taichi()


def test_stale_lock_of_the_kernel_cache_is_removed_and_a_live_one_kept(tmp_path):
    stale, live = tmp_path / "ticache.lock", tmp_path / "other.lock"
    for lock in (stale, live):
        lock.touch()
    an_hour_ago = time.time() - 3600.0
    os.utime(stale, (an_hour_ago, an_hour_ago))
    runtime._remove_stale_lock(tmp_path)
    assert not stale.exists()
    assert live.exists()


def test_processes_that_fill_a_new_kernel_cache_at_the_same_time_do_no_harm(tmp_path):
    """As the processes of a test run do; what they leave serves the next one."""
    environment = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path), "PYTHONPATH": str(PROJECT)}

    def start() -> subprocess.Popen[bytes]:
        # It compiles a kernel, and checks what that computes.
        return subprocess.Popen([sys.executable, "-m", "sim.core.runtime", "--probe", "cpu"], env=environment)

    assert [process.wait(120) for process in [start() for _ in range(3)]] == [0, 0, 0]
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("**/*.tic")}
    assert kept
    assert not list(tmp_path.glob("**/*.lock"))
    assert start().wait(120) == 0
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("**/*.tic")} == kept


def test_device_error_survives_pickling():
    error = DeviceUnavailableError("cuda", "no driver")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(
    ("named", "gpu", "seen"), [(None, 1, "1"), ("GPU-a, GPU-b", 1, "GPU-b"), ("5", 0, "5"), (None, None, None)]
)
def test_a_simulation_sees_its_own_gpu_alone_when_taichi_starts(monkeypatch, named, gpu, seen):
    started = []
    monkeypatch.setattr(runtime, "_in_use", {})
    monkeypatch.setattr(runtime, "resolve_device", lambda device: device)
    monkeypatch.setattr(runtime, "_start_taichi", lambda *_: started.append(os.environ.get("CUDA_VISIBLE_DEVICES")))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # so that what `initialize` puts there does not stay
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    if named is None:
        monkeypatch.setattr(Path, "glob", lambda *_: [Path("/dev/nvidia0"), Path("/dev/nvidia1")])
    else:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
    assert initialize("cuda", gpu=gpu) == "cuda"
    assert started == [seen]
    monkeypatch.setattr(runtime, "_in_use", {})
    with pytest.raises(DeviceUnavailableError, match="there is no GPU 7"):
        initialize("cuda", gpu=7)
