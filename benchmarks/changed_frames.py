"""Frames of finished jobs, drawn with something changed in what Blender is told."""

from __future__ import annotations

import tempfile
import time
from contextlib import closing
from pathlib import Path

from render.blender import open_renderer
from render.spec import RenderSpec


def specification(folder: Path) -> RenderSpec:
    """What Blender was told of a job."""
    return RenderSpec.model_validate_json((folder / "scene.json").read_text(encoding="utf-8"))


def draw(spec: RenderSpec, folder: Path, picture: Path, *, frame: int, threads: int, repeats: int) -> dict[str, float]:
    """Draw a frame of a job, and measure how long that takes, by the clock and in processor time [s].

    Args:
        spec: what Blender is told.
        folder: of the job, where the paths of the specification start.
        picture: where the last picture goes.
        frame: its number.
        threads: of the renderer.
        repeats: pictures of which the least counts, after a first one that warms up. 0: the first counts.
    """
    least = {"wall_s": float("inf"), "cpu_s": float("inf")}
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".json") as file:
        spec.write(Path(file.name))
        with closing(open_renderer(Path(file.name), threads=threads, blender=None)) as renderer:
            for number in range(repeats + 1):
                wall, processor = time.perf_counter(), time.process_time()
                renderer.render(frame, picture)
                seconds = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - processor}
                if number or not repeats:
                    least = {key: min(least[key], value) for key, value in seconds.items()}
    return {key: round(value, 2) for key, value in least.items()}
