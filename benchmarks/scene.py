"""How long the physics of a job takes, frame by frame, without writing anything; JSON on the standard output.

python -m benchmarks.scene jobs/drop_on_bunny_dfsph.toml --device cuda
python -m benchmarks.scene jobs/drop_on_bunny_dfsph.toml --preview --frames 30
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.job.loading import read_job
from sim.runtime import initialize

MIN_FRAMES_BETWEEN_LINES = 20


def main() -> None:
    """Compute the job's frames and print what they took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", type=Path)
    parser.add_argument("--preview", action="store_true", help="the small version of the job")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for pipeline submit")
    parser.add_argument("--frames", type=int, help="frames to compute; those of the job if omitted")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--snapshots", type=Path, help="folder for particle positions of some frames, as .npz")
    parser.add_argument("--snapshot-every", type=int, default=60)
    arguments = parser.parse_args()
    job = read_job(arguments.job, arguments.set, preview=arguments.preview).job
    device = initialize(arguments.device, threads=arguments.threads)

    from sim.build import build_world

    started = time.perf_counter()
    world = build_world(job, frames_per_second=job.fps)
    built_s = time.perf_counter() - started
    frames = []
    for frame in range(1, (arguments.frames or job.frame_count - 1) + 1):
        begin = time.perf_counter()
        report = world.advance_frame()
        frames.append(
            {
                "wall_s": time.perf_counter() - begin,
                "substeps": dict(report.substeps),
                "diagnostics": {name: dict(values) for name, values in report.diagnostics.items()},
            }
        )
        if frame % MIN_FRAMES_BETWEEN_LINES == 0:
            sys.stderr.write(f"frame {frame}: {sum(each['wall_s'] for each in frames):.1f} s\n")
        if arguments.snapshots and frame % arguments.snapshot_every == 0:
            arguments.snapshots.mkdir(parents=True, exist_ok=True)
            arrays = {
                f"{name}.{key}": value
                for name, body in world.snapshots().items()
                for key, value in body.arrays.items()
                if key in ("position", "velocity", "orientation")
            }
            np.savez_compressed(arguments.snapshots / f"{frame:06d}.npz", **arrays)
    # The first frame compiles the kernels.
    wall = [each["wall_s"] for each in frames]
    result = {
        "job": job.name,
        "device": device,
        "frames": len(frames),
        "simulated_s": len(frames) / job.fps,
        "building_s": built_s,
        "wall_s": sum(wall),
        "wall_without_first_frame_s": sum(wall[1:]),
        "substeps": {name: sum(each["substeps"].get(name, 0) for each in frames) for name in frames[0]["substeps"]},
        "last_frame": frames[-1]["diagnostics"],
        "energy": {
            name: [
                sum(
                    each["diagnostics"][name].get(f"{kind}_energy", 0.0) for kind in ("kinetic", "potential", "elastic")
                )
                for each in frames
            ]
            for name in frames[0]["diagnostics"]
        },
    }
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
