"""What each knob of the draft preset gives: one frame of a finished job, drawn with one setting changed at a time.

    python -m benchmarks.render_knobs renders/quickstart --frame 32 [--threads 2] [--rounds 3]

All settings take turns in one process, round after round, and the least of each counts. Prints JSON: seconds by the
clock and of processor time, by setting.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.json_output import keep_output_for_json
from render.blender import open_renderer


def variants(scene) -> dict[str, Callable[[], None]]:
    """Changes of the scene's settings, by name."""
    import bpy

    cycles = scene.cycles

    def change(owner, name: str, value) -> Callable[[], None]:
        return lambda: setattr(owner, name, value)

    def hide_smoke() -> None:
        for each in bpy.data.objects:
            each.hide_render = each.type == "VOLUME"

    return {
        "preset": lambda: None,
        "1 sample": change(cycles, "samples", 1),
        "twice the samples": change(cycles, "samples", 2 * cycles.samples),
        "no motion blur": change(scene.render, "use_motion_blur", False),
        "light tree": change(cycles, "use_light_tree", True),
        "no denoising": change(cycles, "use_denoising", False),
        "guides not cleaned": change(cycles, "denoising_prefilter", "FAST"),
        "no diffuse bounce": change(cycles, "diffuse_bounces", 0),
        "no smoke": hide_smoke,
        "unbiased volumes": change(cycles, "volume_biased", False),
    }


def measure(folder: Path, *, frame: int, threads: int, rounds: int) -> dict[str, dict[str, float]]:
    """Least seconds of each variant."""
    renderer = open_renderer(folder / "scene.json", threads=threads, blender=None)
    import bpy

    scene = bpy.context.scene
    owners = {
        scene.cycles: (
            *("samples", "use_light_tree", "use_denoising", "denoising_prefilter"),
            *("diffuse_bounces", "volume_biased"),
        ),
        scene.render: ("use_motion_blur",),
    }
    preset = [(owner, name, getattr(owner, name)) for owner, names in owners.items() for name in names]
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for _ in range(rounds):
            for name, apply in variants(scene).items():
                apply()
                wall, processor = time.perf_counter(), time.process_time()
                renderer.render(frame, Path(scratch) / "frame.png")
                seconds = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - processor}
                best = results.setdefault(name, seconds)
                results[name] = {key: round(min(best[key], value), 3) for key, value in seconds.items()}
                for owner, attribute, value in preset:
                    setattr(owner, attribute, value)
                for each in bpy.data.objects:
                    each.hide_render = False
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of a finished job")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    keep_output_for_json()
    results = measure(arguments.folder, frame=arguments.frame, threads=arguments.threads, rounds=arguments.rounds)
    json.dump({"benchmark": "render_knobs", "frame": arguments.frame, "results": results}, sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
