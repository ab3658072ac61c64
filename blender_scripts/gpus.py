"""The GPUs that Cycles can draw on: which there are, and one of them for this process.

    blender --background --factory-startup --disable-autoexec --python gpus.py --

writes a line `GPUS {"backend": "OPTIX", "devices": [{"name": ..., "id": ...}]}` for each back end that this Blender
has, among the lines that Blender itself writes, and `GPUS_DONE version` at the end; so does `python gpus.py` with the
bpy module. A line is written as soon as it is known: the driver of another back end may end the process.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import bpy

BACKENDS = ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL")  # the order in which `auto` and `gpu` take them


def gpus_of(backend: str) -> list[Any]:
    """Cycles' devices of a back end, in the driver's order; the back end is the chosen one then.

    Blender accepts a back end without a device behind it and silently renders on the CPU; so the devices are counted.
    """
    preferences = bpy.context.preferences.addons["cycles"].preferences
    try:
        preferences.compute_device_type = backend
    except TypeError:
        # This build of Blender does not know the back end.
        return []
    preferences.get_devices()
    return [device for device in preferences.devices if device.type == backend]


def choose_device(wanted: str, gpu: int | None) -> str:
    """Select what Cycles renders and denoises on, and say what it is, e.g. `CPU` or `OPTIX: NVIDIA RTX 4090`.

    Args:
        wanted: `auto`, `cpu`, `gpu`, or a back end in lower case.
        gpu: which of the GPUs, counted from 0; the others are left to other processes. None: none of them.

    Raises:
        RuntimeError: a GPU is wanted and is not there.
    """
    cycles = bpy.context.scene.cycles
    cycles.device = "CPU"
    cycles.denoising_use_gpu = False
    if wanted == "cpu" or (wanted == "auto" and gpu is None):
        return "CPU"
    for backend in BACKENDS if wanted in ("auto", "gpu") else (wanted.upper(),):
        found = gpus_of(backend)
        if gpu is not None and gpu < len(found):
            for device in bpy.context.preferences.addons["cycles"].preferences.devices:
                device.use = False
            found[gpu].use = True
            cycles.device = "GPU"
            cycles.denoising_use_gpu = True  # Blender's default is the processor, which takes longer than the picture
            return f"{backend}: {found[gpu].name}"
        if found and wanted != "auto":
            there = ", ".join(device.name for device in found)
            raise RuntimeError(f'render.device is "{wanted}", and GPU {gpu}, counted from 0, is not among {there}')
    if wanted == "auto":
        return "CPU"
    raise RuntimeError(f'render.device is "{wanted}", but Cycles finds none; use "auto" or "cpu"')


def main() -> None:
    """Write which GPUs there are."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for backend in BACKENDS:
        devices = [{"name": device.name, "id": device.id} for device in gpus_of(backend)]
        sys.stdout.write(f"GPUS {json.dumps({'backend': backend, 'devices': devices})}\n")
        sys.stdout.flush()
    sys.stdout.write(f"GPUS_DONE {bpy.app.version_string}\n")


if __name__ == "__main__":
    main()
