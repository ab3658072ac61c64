"""Seconds a frame of the quality presets: frames of finished jobs, at a film's size.

    python -m benchmarks.presets renders/dam_break renders/campfire --frame 90 [--resolution 1280 720]
        [--presets draft preview final] [--device auto] [--threads 2] [--repeats 2]

A renderer is opened for each job and preset; its first picture warms up and is not counted, of the others the least
counts. With `--repeats 0` the first is counted, warming up included. Prints JSON by job and preset: seconds by the
clock and of processor time.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from benchmarks.changed_frames import draw, specification
from benchmarks.json_output import keep_output_for_json

PRESETS = ("draft", "preview", "final")


def measure(folder: Path, *, frame: int, changes: dict[str, object], threads: int, repeats: int) -> dict[str, float]:
    """Least seconds of a frame of a job whose render settings are changed so."""
    spec = specification(folder)
    changed = spec.model_copy(update={"render": spec.render.model_copy(update=changes)})
    with tempfile.TemporaryDirectory() as scratch:
        return draw(changed, folder, Path(scratch) / "frame.png", frame=frame, threads=threads, repeats=repeats)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="folders of jobs of which the frame is there")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--resolution", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=PRESETS)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    keep_output_for_json()
    results: dict[str, dict[str, dict[str, float]]] = {}
    for folder in arguments.folders:
        for preset in arguments.presets:
            changes: dict[str, object] = {
                "quality": preset,
                "resolution": tuple(arguments.resolution),
                "device": arguments.device,
            }
            results.setdefault(folder.name, {})[preset] = measure(
                folder, frame=arguments.frame, changes=changes, threads=arguments.threads, repeats=arguments.repeats
            )
            print(folder.name, preset, results[folder.name][preset], file=sys.stderr, flush=True)
    record = {
        "benchmark": "presets",
        "frame": arguments.frame,
        "resolution": arguments.resolution,
        "device": arguments.device,
        "threads": arguments.threads,
        "results": results,
    }
    json.dump(record, sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
