"""What the settings of a fluid's surface cost and look like: one frame of a job, meshed and drawn with each of them.

    python -m benchmarks.surface_looks renders/quickstart --frame 30 -o docs/images [--zoom 2] [--only default ...]

Of the job's folder only the cached frame and the meshes of its bodies are read; smoke, cloth and whitewater are left
out, and nothing is blurred. Writes `surface-looks.webp`, a strip of close-ups with the settings' names, and prints
JSON and, to the standard error, a Markdown table: processor seconds (median of three, one thread), the memory that
meshing adds, triangles, volume against that of the particles, bumps of the particles' size on the body of the water
(`surface_measures`), and how many parts are droplets and how wide their median is.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.json_output import keep_output_for_json
from pipeline.cache import read_frame
from pipeline.job.loading import load_job
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.render_scene import framed_points, render_spec, write_motion
from render.blender import open_renderer
from render.camera_path import View
from render.parameters import CameraParameters, SurfaceParameters
from render.sheet import contact_sheet
from render.surface import pipeline_options

COLUMNS = 3
WEBP_QUALITY = 55
"""Some 6 KB a picture of 320x180 full of splashes."""


@dataclass(frozen=True)
class Setting:
    """A row of the table: what differs from the defaults.

    Attributes:
        name: of its row and its picture.
        keys: of `[surface]`, as a job says them.
        splashsurf: arguments of splashsurf that no job changes.
    """

    name: str
    keys: dict[str, Any] = field(default_factory=dict)
    splashsurf: dict[str, Any] = field(default_factory=dict)

    @property
    def options(self) -> dict[str, Any]:
        """All of them, as `benchmarks.surface_measures` takes them."""
        parameters = SurfaceParameters(**self.keys)
        return {**pipeline_options(parameters), "droplet_size": parameters.droplet_size, **self.splashsurf}


SETTINGS = (
    Setting("default"),
    Setting("droplets as they are", {"droplet_size": 1.0}),
    Setting("droplets 0.25", {"droplet_size": 0.25}),
    Setting("cube 1", {"cube_size_in_radii": 1.0}),
    Setting("cube 0.5", {"cube_size_in_radii": 0.5}),
    Setting("length 1.5", {"smoothing_length_in_radii": 1.5}),
    Setting("length 2.5", {"smoothing_length_in_radii": 2.5}),
    Setting("threshold 0.5", {"threshold": 0.5}),
    Setting("threshold 0.4", {"threshold": 0.4}),
    Setting("no smoothing", {"mesh_smoothing_iterations": 0}),
    Setting("smoothing 10", {"mesh_smoothing_iterations": 10}),
    Setting("smoothing 50", {"mesh_smoothing_iterations": 50}),
    Setting("smoothing not weighted", {}, {"mesh_smoothing_weights": False}),
    Setting("no mesh cleanup", {}, {"mesh_cleanup": False}),
    Setting("barnacles stay", {}, {"decimate_barnacles": False}),
    Setting("raw contour", {"mesh_smoothing_iterations": 0}, {"mesh_cleanup": False, "decimate_barnacles": False}),
    Setting("normals not smoothed", {"normals_smoothing_iterations": 0}),
    Setting("normals by SPH", {}, {"sph_normals": True}),
)

HEAD = (
    "| setting | processor seconds | memory [MB] | triangles | volume | bumps [°] | droplets | their width [radii] |",
    "|---|---|---|---|---|---|---|---|",
)


def row(name: str, numbers: dict[str, Any]) -> str:
    """A row of the table."""
    bumps, width = numbers["bumps_deg"], numbers["droplet_width_in_radii"]
    cells = (
        *(name, f"{numbers['cpu_s']:.2f}", f"{numbers['memory_mb']:.0f}", f"{numbers['triangles']:,}"),
        *(f"{numbers['volume_error']:+.1%}", "–" if bumps is None else f"{bumps:.1f}"),
        *(str(numbers["droplets"]), "–" if width is None else f"{width:.1f}"),
    )
    return f"| {' | '.join(cells)} |"


def measure(particles: Path, surface: Path, setting: Setting) -> dict[str, Any]:
    """Mesh in a process of its own; what it tells."""
    command = [sys.executable, "-m", "benchmarks.surface_measures", particles, surface, json.dumps(setting.options)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


class Studio:
    """Draws surfaces into the scene of a job at one frame."""

    def __init__(self, folder: Path, job: Job, fluid: str, options: argparse.Namespace) -> None:
        self._frame, scratch = options.frame, JobLayout(folder)
        for part in ("cache", "meshes", "inputs", "bounds.json"):
            (folder / part).symlink_to((options.folder / part).resolve())
        _, view = write_motion(job, scratch, self._frame, attempt=1)
        scene = job.model_copy(
            update={
                "camera": close_up(view, options),
                "fluid": tuple(each for each in job.fluid if each.name == fluid),
                **{"smoke": (), "cloth": (), "whitewater": {}},
                "render": job.render.model_copy(
                    update={"resolution": tuple(options.resolution), "quality": options.quality, "motion_blur": False}
                ),
            }
        )
        render_spec(scene, scratch, framed_points(scene, scratch)).write(folder / "scene.json")
        self.surface = scratch.path(scratch.surface(fluid, self._frame))
        self.surface.parent.mkdir(parents=True)
        self._renderer = open_renderer(folder / "scene.json", threads=2, blender=None)

    def draw(self, picture: Path) -> None:
        """Draw what lies at `surface`."""
        self._renderer.render(self._frame, picture)


def close_up(view: View, options: argparse.Namespace) -> CameraParameters:
    """The job's camera at the frame, nearer by its lens, or where the command line puts it."""
    return CameraParameters(
        position=tuple(options.position or view.position),
        look_at=tuple(options.look_at or view.look_at),
        focal_length_mm=view.focal_length_mm * options.zoom,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of a job with the cached frame")
    parser.add_argument("--frame", type=int, required=True)
    parser.add_argument("--fluid", help="which fluid; the job's first if omitted")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the strip")
    parser.add_argument("--name", default="surface-looks", help="of the strip, without suffix")
    parser.add_argument("--only", nargs="+", default=[], help="names of settings (default: all)")
    parser.add_argument("--zoom", type=float, default=2.0, help="factor on the camera's focal length")
    parser.add_argument("--position", type=float, nargs=3, help="of the camera [m]; as in the job if omitted")
    parser.add_argument("--look-at", type=float, nargs=3, help="what it looks at [m]; as in the job if omitted")
    parser.add_argument("--resolution", type=int, nargs=2, default=(320, 180), help="of a picture")
    parser.add_argument("--quality", default="draft", choices=("draft", "preview", "final"))
    parser.add_argument("--keep", type=Path, help="folder for the single pictures, as PNG")
    options = parser.parse_args()
    keep_output_for_json()

    layout = JobLayout(options.folder)
    job = load_job(layout.job_file)
    fluid = options.fluid or job.fluid[0].name
    body = read_frame(layout.path(layout.frame_cache(options.frame)), fluid).bodies[fluid]
    settings = [setting for setting in SETTINGS if not options.only or setting.name in options.only]
    results = {}
    with tempfile.TemporaryDirectory(prefix="surface-looks-") as name:
        folder = Path(name)
        particles, pictures = folder / "particles.npz", options.keep or folder / "pictures"
        pictures.mkdir(exist_ok=True)
        np.savez(
            particles,
            positions=body.arrays["position"],
            velocities=body.arrays["velocity"],
            radius=body.number("particle_radius"),
        )
        studio = Studio(folder, job, fluid, options)
        print("\n".join(HEAD), file=sys.stderr, flush=True)
        for number, setting in enumerate(settings):
            results[setting.name] = measure(particles, studio.surface, setting)
            studio.draw(pictures / f"{number:02d}.png")
            print(row(setting.name, results[setting.name]), file=sys.stderr, flush=True)
        contact_sheet(
            [pictures / f"{number:02d}.png" for number in range(len(settings))],
            folder / "strip.png",
            columns=COLUMNS,
            labels=[setting.name for setting in settings],
        )
        with Image.open(folder / "strip.png") as strip:
            strip.save(options.output / f"{options.name}.webp", quality=WEBP_QUALITY)
    document = {
        **{"benchmark": "surface_looks", "job": job.name, "frame": options.frame},
        "particles": len(body.arrays["position"]),
        "settings": {setting.name: {"options": setting.options, **results[setting.name]} for setting in settings},
    }
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
