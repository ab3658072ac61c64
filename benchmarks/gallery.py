"""The gallery of the sample jobs: docs/gallery.md, with a picture and a contact sheet of each.

    python -m benchmarks.gallery renders --machine "32 cores and two NVIDIA H200" [-o docs] [--hero dam_break=60]

Takes the frames that are there of each job of jobs/, as it was submitted, and the time that they took by its record;
a job may be drawn in part, with `render.order = "spread"`. Jobs without frames are left out, and named.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.manifest_reader import ManifestReader
from pipeline.picture_set import picture_set
from pipeline.task import ArtifactPath
from render.sheet import contact_sheet

JOBS = Path(__file__).resolve().parent.parent / "jobs"
HERO_WIDTH, SHEET_WIDTH = 800, 1200
"""Of the pictures [pixels]."""
PICTURES, COLUMNS = 12, 4
"""On a contact sheet."""
QUALITY = 80
"""Of WebP."""
STAGES = ("simulate", "surface", "volume", "render")
"""Whose times are told."""


class Shot(NamedTuple):
    """What the gallery says of a job; `seconds` are those of a frame, by stage."""

    name: str
    text: str
    resolution: tuple[int, int]
    quality: str
    drawn: int
    frames: int
    seconds: dict[str, float]


def description(job_file: Path) -> str:
    """The comment at the head of a job file, without hints at commands."""
    lines = []
    for line in job_file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        text = line.removeprefix("#")
        if not line.startswith("#:") and not text.startswith("   "):
            lines.append(text.strip())
    return " ".join(lines)


def shot_of(job_file: Path, layout: JobLayout) -> tuple[Shot, list[Path]]:
    """What there is to tell of a job, and its frames."""
    job = load_job(layout.job_file)
    pictures = picture_set(job, layout).all
    with ManifestReader.open_readonly(layout.manifest) as reader:
        frames: dict[str, set[str]] = {}
        for path, row in reader.artifacts().items():
            frames.setdefault(row.task.partition("/")[0], set()).update(frame_of(path))
        seconds = {
            timing.stage: timing.seconds / len(frames[timing.stage])
            for timing in reader.stage_timings()
            if frames.get(timing.stage) and timing.seconds
        }
    render, text = job.render, description(job_file)
    return (
        Shot(job_file.stem, text, render.resolution, render.quality, len(pictures), job.frame_count, seconds),
        pictures,
    )


def frame_of(artifact: ArtifactPath) -> list[str]:
    """The frame that a file belongs to, of which there may be several files; empty if it belongs to none."""
    stem = Path(artifact).stem
    return [stem] if stem.isdigit() else []


def nearest(frames: list[Path], wanted: int) -> Path:
    """The frame whose number is nearest."""
    return min(frames, key=lambda path: abs(int(path.stem) - wanted))


def spread_in_time(frames: list[Path], count: int) -> list[Path]:
    """At most so many frames, as evenly spread over the film as those that are there allow."""
    last = int(frames[-1].stem)
    chosen = {nearest(frames, round(index * last / (count - 1))) for index in range(count)}
    return sorted(chosen)


def write_pictures(shot: Shot, frames: list[Path], images: Path, hero: int) -> None:
    """`gallery-NAME.webp` and `gallery-NAME-sheet.webp`."""
    with Image.open(nearest(frames, hero)) as picture:
        shown = picture.convert("RGB")
    if shown.width > HERO_WIDTH:
        shown = shown.resize((HERO_WIDTH, round(shown.height * HERO_WIDTH / shown.width)), Image.Resampling.LANCZOS)
    shown.save(images / f"gallery-{shot.name}.webp", quality=QUALITY, method=6)
    path = images / f"gallery-{shot.name}-sheet.webp"
    contact_sheet(spread_in_time(frames, PICTURES), path, columns=COLUMNS, width=SHEET_WIDTH)


def section(shot: Shot) -> str:
    """A job in Markdown."""
    width, height = shot.resolution
    times = "; ".join(f"{stage} {figure(shot.seconds[stage])} s" for stage in STAGES if stage in shot.seconds)
    took = f" A frame took: {times}." if times else ""
    drawn = "all" if shot.drawn == shot.frames else str(shot.drawn)
    return f"""## {shot.name}
![{shot.name}](images/gallery-{shot.name}.webp)

{shot.text}

{width}x{height}, {shot.quality} quality; {drawn} of {shot.frames} frames drawn.{took}

![frames of {shot.name}](images/gallery-{shot.name}-sheet.webp)
"""


def figure(seconds: float) -> str:
    """A time in two digits."""
    return f"{seconds:.2g}" if seconds < 10.0 else f"{seconds:.0f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path, help="folder that holds the jobs' folders")
    parser.add_argument("--machine", required=True, help="what they ran on")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"))
    parser.add_argument("--hero", action="append", default=[], metavar="JOB=FRAME", help="frame to show large")
    arguments = parser.parse_args()
    heroes = {name: int(frame) for name, _, frame in (each.partition("=") for each in arguments.hero)}
    images = arguments.output / "images"
    images.mkdir(parents=True, exist_ok=True)
    sections, missing = [], []
    for job_file in sorted(JOBS.glob("*.toml")):
        layout = JobLayout(arguments.renders / job_file.stem)
        shot, frames = shot_of(job_file, layout) if layout.manifest.exists() else (None, [])
        if shot is None or not frames:
            missing.append(job_file.stem)
            continue
        write_pictures(shot, frames, images, heroes.get(shot.name, shot.frames // 2))
        sections.append(section(shot))
    head = f"""# Gallery

The jobs of [jobs/](../jobs) as they are, one after the other. Each can be made with `pipeline submit jobs/NAME.toml`.
Made on {arguments.machine}. Seconds are what a stage's tasks took beside all others; what a
frame takes alone is in [rendering](rendering.md#quality-presets). Where not all frames are drawn, the run ended before
they were: they are from all over what was simulated until then. Written by `python -m benchmarks.gallery`.
"""
    (arguments.output / "gallery.md").write_text("\n".join([head, *sections]), encoding="utf-8")
    print(f"{len(sections)} jobs; without frames: {', '.join(missing) or 'none'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
