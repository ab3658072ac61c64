"""The GPUs that Cycles can draw on, probed by Blender in a child process, as a driver may crash its caller."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from render.blender import BlenderHungError, BlenderUnavailableError, early_end, run_script, script_argv

PROBE_TIMEOUT_S = 120.0
ANY_KIND = ("auto", "gpu")


@dataclass(frozen=True, slots=True)
class Gpu:
    """A device of Cycles: its back end (OPTIX, CUDA, HIP, ONEAPI or METAL), its driver's name for it, and its id.

    NVIDIA's GPUs are one of OptiX and one of CUDA each.
    """

    backend: str
    name: str
    id: str

    def __str__(self) -> str:
        return f"{self.backend}: {self.name}"


@dataclass(frozen=True, slots=True)
class Probe:
    """Result of a probe for GPUs.

    Attributes:
        gpus: those that Cycles finds, its preferred back end first, each back end's in the driver's order.
        trouble: why there may be more of them, or "": the process ended, or hung, before it had tried all back ends.
    """

    gpus: tuple[Gpu, ...] = ()
    trouble: str = ""

    def of_kind(self, device: str) -> tuple[Gpu, ...]:
        """Those that a value of `render.device` means; an index counts in these. Of any kind: the first back end's."""
        if device == "cpu" or not self.gpus:
            return ()
        backend = self.gpus[0].backend if device in ANY_KIND else device.upper()
        return tuple(gpu for gpu in self.gpus if gpu.backend == backend)


def find_gpus(blender: str | None) -> Probe:
    """Ask Blender, an executable or the bpy module, for the GPUs of this machine; takes a second or two."""
    try:
        completed = run_script(script_argv(blender, "gpus.py", []), timeout_s=PROBE_TIMEOUT_S, purpose="look for GPUs")
    except BlenderHungError as error:
        return Probe(read_answer(error.told.splitlines()), str(error))
    except (BlenderUnavailableError, OSError) as error:
        return Probe(trouble=str(error))
    lines = completed.stdout.splitlines()
    if any(line.startswith("GPUS_DONE ") for line in lines):
        return Probe(read_answer(lines))
    return Probe(read_answer(lines), early_end(completed, "looked for GPUs"))


def read_answer(lines: Sequence[str]) -> tuple[Gpu, ...]:
    """The GPUs in the script's output, those of the preferred back end first."""
    gpus: list[Gpu] = []
    for line in lines:
        if line.startswith("GPUS "):
            told = json.loads(line.partition(" ")[2])
            gpus += [Gpu(told["backend"], device["name"], device["id"]) for device in told["devices"]]
    return tuple(gpus)
