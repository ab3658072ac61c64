"""What wetting changes in a picture, and what it takes: a frame of a finished job, drawn without it and with it.

    python -m benchmarks.wet_surfaces renders/floating_bodies-preview --frame 79 [-o docs/images]
        [--resolution 480 270] [--samples 24] [--threads 2] [--repeats 1]

Writes `wet-surfaces.webp`, both pictures beside each other. Prints JSON: seconds a picture as `benchmarks.presets`
counts them, the wetting's part of them (least of its pictures), the vertices of the fluids, and how far they are above
the floor that they face, in radii of particles (median and 99th percentile of those within two).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.changed_frames import draw, specification
from benchmarks.json_output import keep_output_for_json
from pipeline.stages.render_scene import WETS_WITHIN_RADII
from render.spec import MeshSequenceObject, RenderSpec


def dry(spec: RenderSpec) -> RenderSpec:
    """The same scene, with air between fluids and what they touch."""
    objects = [
        each.model_copy(update={"wets_within": None}) if isinstance(each, MeshSequenceObject) else each
        for each in spec.objects
    ]
    return spec.model_copy(update={"objects": tuple(objects)})


def count_wetting() -> list[dict[str, float]]:
    """Have every call of the wetting counted from now on: processor seconds, vertices, radii above the floor."""
    import bpy  # noqa: F401 - brings what wetting imports

    from blender_scripts import wetting

    calls: list[dict[str, float]] = []
    whole = wetting.wetted

    def counted(mesh: Any, **how: Any) -> Any:
        began = time.process_time()
        result = whole(mesh, **how)
        seconds = time.process_time() - began
        above = (mesh.positions[:, 2] - how["floor_z"]) * WETS_WITHIN_RADII / how["reach"]
        gaps = above[(mesh.normals[:, 2] < -0.9) & (above < 2.0)]
        median, most = np.percentile(gaps, (50.0, 99.0)) if len(gaps) else (0.0, 0.0)
        calls.append({"cpu_s": seconds, "vertices": len(mesh.positions), "median": median, "most": most})
        return result

    wetting.wetted = counted
    return calls


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a job of which the frame is there")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="folder for the pictures")
    parser.add_argument("--resolution", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--samples", type=int, default=24)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    keep_output_for_json()
    told = specification(arguments.folder)
    changes = {"resolution": tuple(arguments.resolution), "samples": arguments.samples, "quality": "preview"}
    told = told.model_copy(update={"render": told.render.model_copy(update=changes)})
    calls = count_wetting()
    seconds = {}
    with tempfile.TemporaryDirectory() as scratch:
        pictures = []
        for name, spec in (("dry", dry(told)), ("wet", told)):
            pictures.append(Path(scratch) / f"{name}.png")
            seconds[name] = draw(
                spec,
                arguments.folder,
                pictures[-1],
                frame=arguments.frame,
                threads=arguments.threads,
                repeats=arguments.repeats,
            )
        if arguments.output is not None:
            width, height = arguments.resolution
            both = Image.new("RGB", (2 * width, height))
            for place, path in enumerate(pictures):
                with Image.open(path) as picture:
                    both.paste(picture.convert("RGB"), (place * width, 0))
            both.save(arguments.output / "wet-surfaces.webp", quality=80, method=6)
    record = {
        "benchmark": "wet_surfaces",
        "job": arguments.folder.name,
        "frame": arguments.frame,
        "resolution": arguments.resolution,
        "samples": arguments.samples,
        "threads": arguments.threads,
        "pictures": seconds,
        "wetting_cpu_s": round(min(call["cpu_s"] for call in calls), 4),
        "vertices": max(call["vertices"] for call in calls),
        "above_floor_radii": [round(float(calls[-1][name]), 2) for name in ("median", "most")],
    }
    json.dump(record, sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
