"""Which device a renderer draws on, in Blender itself."""

from __future__ import annotations

import json

from needed_blender import needs_bpy
from warm_python import run_python

pytestmark = needs_bpy

# What Cycles lists on every machine, its processor, stands for the GPUs of a back end: choosing works alike.
CHOOSE = """
    import json
    from unittest.mock import patch
    import bpy
    from blender_scripts import gpus

    bpy.ops.wm.read_factory_settings(use_empty=True)
    preferences = bpy.context.preferences.addons["cycles"].preferences
    preferences.get_devices()
    there = {}
    listed = patch.object(gpus, "gpus_of", lambda backend: there.get(backend, []))
    listed.start()

    def choose(wanted, gpu):
        for device in preferences.devices:
            device.use = True
        try:
            told = gpus.choose_device(wanted, gpu)
        except RuntimeError as error:
            told = f"refused: {error}"
        used = [device.name for device in preferences.devices if device.use]
        cycles = bpy.context.scene.cycles
        return [told, cycles.device, cycles.denoising_use_gpu, len(used)]

    (card,) = (device for device in preferences.devices if device.type == "CPU")
    answers = {"name": card.name, "without": {}, "with": {}}
    cases = [("auto", 0), ("auto", None), ("cpu", 0), ("gpu", 0), ("hip", 0)]
    for wanted, gpu in cases:
        answers["without"][f"{wanted} {gpu}"] = choose(wanted, gpu)
    there["CUDA"] = [card]
    for wanted, gpu in [*cases, ("cuda", 0), ("cuda", 1), ("auto", 1)]:
        answers["with"][f"{wanted} {gpu}"] = choose(wanted, gpu)
    listed.stop()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    print("ANSWERS", json.dumps(answers))
"""
CPU = ["CPU", "CPU", False]


def test_a_renderer_enables_the_gpu_it_was_given_and_takes_the_processor_only_where_the_job_says_so():
    (line,) = (line for line in run_python(CHOOSE).splitlines() if line.startswith("ANSWERS "))
    answers = json.loads(line.partition(" ")[2])
    without, with_card = answers["without"], answers["with"]
    on_card = [f"CUDA: {answers['name']}", "GPU", True, 1]
    for case in ("auto 0", "auto None", "cpu 0"):
        assert without[case][:3] == CPU
    assert without["gpu 0"][0] == 'refused: render.device is "gpu", but Cycles finds none; use "auto" or "cpu"'
    assert with_card["auto 0"] == with_card["gpu 0"] == with_card["cuda 0"] == on_card
    for case in ("auto None", "cpu 0", "auto 1"):
        assert with_card[case][:3] == CPU
    assert with_card["hip 0"][0].startswith('refused: render.device is "hip", but Cycles finds none')
    refused = f'refused: render.device is "cuda", and GPU 1, counted from 0, is not among {answers["name"]}'
    assert with_card["cuda 1"][0] == refused
