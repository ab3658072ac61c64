"""The GPUs that a job's pictures can be drawn on: found in a child process, and remembered for this machine.

Cycles numbers them differently from Taichi, and drives some that Taichi does not, so Blender itself is asked.
"""

import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replacing
from pipeline.base.parameter_set import digest_of
from pipeline.base.task import Task
from pipeline.model.job import Job
from render.gpus import Gpu, Probe, find_gpus
from sim.core.runtime import cache_folder, cuda_gpus

OWN_GPUS = "PIPELINE_GPUS"
"""Environment variable that leaves this process some of the machine's GPUs only, as `0,2`: places in Cycles' list.
Empty: none of them."""

_VISIBILITY = (
    *("CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES"),
    "ONEAPI_DEVICE_SELECTOR",
)
"""Environment variables that hide GPUs from a process, or change their order."""
_DEVICE_FILES = ("nvidia*", "dri/renderD*", "kfd", "dxg")
"""Through which programs reach GPUs on Linux: NVIDIA's, Intel's and AMD's, AMD's for computing, those of WSL."""

GPU_TASKS = 1
"""At least one task at a time on a GPU. Whether there is one, a stage says that has to run."""

TROUBLE_KEPT_S = 3600.0
"""How long an answer that was cut short is kept [s]: a driver that hangs costs two minutes each time it is asked."""


def render_gpus(job: Job) -> tuple[Gpu, ...]:
    """The GPUs of this machine that a job's pictures may be drawn on; a renderer is given one by its place in these."""
    return () if job.render.device == "cpu" else known_gpus(job.render.blender).of_kind(job.render.device)


def own_gpus() -> tuple[int, ...] | None:
    """The places in that list which this process may use, each once, in their order; None: all.

    Raises PipelineError: the variable cannot be read.
    """
    text = os.environ.get(OWN_GPUS)
    if text is None:
        return None
    form = f"{OWN_GPUS}={text}: must be places of GPUs, from 0 on, with commas between them, as 0,1"
    try:
        places = sorted({int(place) for place in text.split(",") if place.strip()})
    except ValueError:
        raise PipelineError(form) from None
    if places and places[0] < 0:
        raise PipelineError(form)
    return tuple(places)


def first_gpu(task: Task) -> int:
    """The place of the GPU that a task gets where tasks run one after another; see `require_some`."""
    own = own_gpus()
    return 0 if own is None or (task.lowest_gpu and not own) else require_some(own)[0]


def require_some(places: Sequence[int]) -> Sequence[int]:
    """The places, or PipelineError where there are none: a task that needs a GPU got past the obstacles."""
    if not places:
        raise PipelineError(f"{OWN_GPUS} leaves this process none of the machine's GPUs, and a task needs one")
    return places


def usable_gpus(job: Job) -> tuple[Gpu, ...]:
    """Those of `render_gpus` that this process may use."""
    found, own = render_gpus(job), own_gpus()
    return found if own is None else tuple(found[place] for place in own if place < len(found))


def gpu_count(job: Job, *, draws: bool) -> int:
    """How many of this machine's GPUs tasks of a job may have: those that draw, else those that simulate."""
    drawing = len(usable_gpus(job)) if draws else 0
    return max(GPU_TASKS, drawing or len(own_gpus() or cuda_gpus()))


def render_trouble(job: Job) -> str:
    """Why a job that takes GPUs where there are any finds none, if there might be; else ""."""
    return "" if job.render.device != "auto" or render_gpus(job) else known_gpus(job.render.blender).trouble


def known_gpus(blender: str | None) -> Probe:
    """All GPUs of this machine, as a Blender executable finds them, or the bpy module (None).

    Asked in a child process. The answer is kept in the user's cache folder until Blender, the driver or the visible
    devices change; one that was cut short is kept for `TROUBLE_KEPT_S`, and by this process.
    """
    if sys.platform == "linux" and not _device_files():
        return Probe()
    return _answer(blender, _key(blender))


def driver_version() -> str:
    """Tells one version of the GPUs' driver from another: NVIDIA's own, or the system that the others belong to."""
    with suppress(OSError):
        return Path("/proc/driver/nvidia/version").read_text(encoding="utf-8")
    return platform.version()


@lru_cache
def _answer(blender: str | None, key: str) -> Probe:
    path = cache_folder() / "render-gpus.json"
    remembered = _remembered(path, key)
    if remembered is not None:
        return remembered
    probe = find_gpus(blender)
    answer = {"key": key, "asked_at": time.time(), **asdict(probe)}
    # A cache folder that cannot be written costs the next process another look, nothing else.
    with suppress(OSError), replacing(path) as part:
        part.write_text(json.dumps(answer, indent=1), encoding="utf-8")
    return probe


def _remembered(path: Path, key: str) -> Probe | None:
    """The remembered answer, or None where there is none for this machine as it is now."""
    try:
        remembered = json.loads(path.read_text(encoding="utf-8"))
        trouble = str(remembered["trouble"])
        age_s = time.time() - float(remembered["asked_at"])
        if remembered["key"] == key and (not trouble or 0.0 <= age_s < TROUBLE_KEPT_S):
            gpus = (Gpu(str(gpu["backend"]), str(gpu["name"]), str(gpu["id"])) for gpu in remembered["gpus"])
            return Probe(tuple(gpus), trouble)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return None


def _key(blender: str | None) -> str:
    """Digest of all that decides which GPUs there are, from files and environment alone."""
    facts = [platform.platform(), platform.node(), driver_version(), *_device_files()]
    facts += [f"{name}={os.environ.get(name)}" for name in _VISIBILITY]
    if blender is None:
        with suppress(PackageNotFoundError):
            facts.append(f"bpy {version('bpy')}")
    else:
        with suppress(OSError):  # one that is not there finds nothing, and is reported elsewhere
            status = Path(blender).stat()
            facts.append(f"{blender} {status.st_size} {status.st_mtime_ns}")
    return digest_of("\n".join(facts))


def _device_files() -> list[str]:
    return sorted(str(path) for pattern in _DEVICE_FILES for path in Path("/dev").glob(pattern))
