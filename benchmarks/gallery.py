"""The gallery of the sample jobs: docs/guide/gallery.md, a picture and a contact sheet of each, and one of them all.

    python -m benchmarks.gallery renders --machine "32 cores and two NVIDIA H200" [-o docs/guide]

Takes the frames that are there of each job of jobs/, as it was submitted, and the time that they took by its record;
a job may be drawn in part, with `render.order = "spread"`. The frame that is shown large may be there better drawn, as
`pipeline still` leaves it. Jobs without frames keep the section that they have, as it was drawn on another day and
machine; those that have none either are left out, and named.
"""

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageOps

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.job.loading import load_job
from pipeline.record.reader import ManifestReader
from pipeline.show.picture_set import picture_set
from render.sheet import contact_sheet

JOBS = Path(__file__).resolve().parent.parent / "jobs"
HEROES = {
    "ball_into_cloth": 34,
    "brick_wall_in_flood": 24,
    "cloth_over_bunny": 22,
    "dam_break": 33,
    "drop_on_bunny_dfsph": 60,
    "drop_on_bunny_wcsph": 60,
    "duck_in_pool_pcisph": 36,
    "everything": 126,
    "smoke_moving_duck": 242,
    "wine_glass": 100,
}
"""The frame of a job to show large, or the drawn one next to it; of other jobs the one in the middle."""
HERO_WIDTH, SHEET_WIDTH = 1280, 1200
"""Of the pictures [pixels]."""
PICTURES, COLUMNS = 12, 4
"""On a contact sheet."""
OVERVIEW, OVERVIEW_WIDTH, OVERVIEW_GAP = "jobs.webp", 1288, 3
"""One picture of each job but the one that the README begins with: its file, width and gaps [pixels]."""
FIRST = "quickstart"
OVERVIEW_BACKGROUND = (16, 16, 18)
QUALITY = 85
"""Of WebP."""
QUALITIES = ("draft", "preview", "final")
STAGES = ("simulate", "surface", "volume", "render")
"""Whose times are told."""


class Hero(NamedTuple):
    """The picture that is shown large."""

    picture: Path
    frame: int
    resolution: tuple[int, int]
    quality: str


class Shot(NamedTuple):
    """What the gallery says of a job; `seconds` are those of a frame, by stage."""

    name: str
    text: str
    resolution: tuple[int, int]
    quality: str
    drawn: int
    frames: int
    seconds: dict[str, float]
    hero: Hero


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


def shot_of(job_file: Path, layout: JobLayout) -> tuple[Shot, list[Path]] | None:
    """What there is to tell of a job, and its frames; None if it has no frame."""
    job = load_job(layout.job_file)
    pictures = picture_set(job, layout).all
    if not pictures:
        return None
    with ManifestReader.open_readonly(layout.manifest) as reader:
        frames: dict[str, set[str]] = {}
        for path, row in reader.artifacts().items():
            frames.setdefault(row.task.partition("/")[0], set()).update(frame_of(path))
        seconds = {
            timing.stage: timing.seconds / len(frames[timing.stage])
            for timing in reader.stage_timings()
            if frames.get(timing.stage) and timing.seconds
        }
    resolution, quality = job.render.resolution, job.render.quality
    shown = nearest(pictures, HEROES.get(job_file.stem, job.frame_count // 2))
    hero = best_still(layout, int(shown.stem)) or Hero(shown, int(shown.stem), resolution, quality)
    text, drawn = description(job_file), len(pictures)
    return Shot(job_file.stem, text, resolution, quality, drawn, job.frame_count, seconds, hero), pictures


def best_still(layout: JobLayout, frame: int) -> Hero | None:
    """The largest still of a frame that `pipeline still` drew since the job was submitted, none of its keys changed."""
    found = []
    for path in layout.stills.glob(f"{frame:06d}-*.png"):
        named = re.fullmatch(r"\d+-(draft|preview|final)-(\d+)x(\d+)", path.stem)
        if named is not None and path.stat().st_mtime_ns >= layout.job_file.stat().st_mtime_ns:
            found.append(Hero(path, frame, (int(named[2]), int(named[3])), named[1]))
    return max(found, key=lambda hero: (hero.resolution, QUALITIES.index(hero.quality)), default=None)


def frame_of(artifact: ArtifactPath) -> list[str]:
    """The frame that a file belongs to, of which there may be several files; empty if it belongs to none."""
    stem = Path(artifact).stem
    return [stem] if stem.isdigit() else []


def nearest(frames: list[Path], wanted: int) -> Path:
    """The frame whose number is nearest."""
    return min(frames, key=lambda path: abs(int(path.stem) - wanted))


def spread_in_time(frames: list[Path], count: int) -> list[Path]:
    """At most so many frames, as evenly spread over the film as those that are there allow; all if few are there."""
    if len(frames) <= count:
        return frames
    last = int(frames[-1].stem)
    chosen = {nearest(frames, round(index * last / (count - 1))) for index in range(count)}
    return sorted(chosen)


def write_pictures(shot: Shot, frames: list[Path], images: Path) -> None:
    """`gallery-NAME.webp` and `gallery-NAME-sheet.webp`."""
    with Image.open(shot.hero.picture) as picture:
        shown = picture.convert("RGB")
    if shown.width > HERO_WIDTH:
        shown = shown.resize((HERO_WIDTH, round(shown.height * HERO_WIDTH / shown.width)), Image.Resampling.LANCZOS)
    shown.save(images / f"gallery-{shot.name}.webp", quality=QUALITY, method=6)
    path = images / f"gallery-{shot.name}-sheet.webp"
    contact_sheet(spread_in_time(frames, PICTURES), path, columns=COLUMNS, width=SHEET_WIDTH)


def write_overview(names: Sequence[str], images: Path) -> None:
    """The large pictures of jobs side by side, as they stand in the gallery."""
    width = (OVERVIEW_WIDTH - (COLUMNS + 1) * OVERVIEW_GAP) // COLUMNS
    height = round(width * 9 / 16)
    rows = -(-len(names) // COLUMNS)
    size = (OVERVIEW_WIDTH, rows * (height + OVERVIEW_GAP) + OVERVIEW_GAP)
    overview = Image.new("RGB", size, OVERVIEW_BACKGROUND)
    for number, name in enumerate(names):
        row, column = divmod(number, COLUMNS)
        with Image.open(images / f"gallery-{name}.webp") as picture:
            small = ImageOps.fit(picture.convert("RGB"), (width, height), Image.Resampling.LANCZOS)
        corner = (OVERVIEW_GAP + column * (width + OVERVIEW_GAP), OVERVIEW_GAP + row * (height + OVERVIEW_GAP))
        overview.paste(small, corner)
    overview.save(images / OVERVIEW, quality=QUALITY, method=6)


def section(shot: Shot, machine: str) -> str:
    """A job in Markdown, which begins with its heading and ends with a line break."""
    times = "; ".join(f"{stage} {figure(shot.seconds[stage])} s" for stage in STAGES if stage in shot.seconds)
    took = f" A frame took: {times}." if times else ""
    drawn = "all" if shot.drawn == shot.frames else str(shot.drawn)
    frames = f"{drawn} of {shot.frames} frames drawn, on {machine}.{took}"
    film, large = how(shot.resolution, shot.quality), how(shot.hero.resolution, shot.hero.quality)
    told = f"{film}; {frames}" if film == large else f"Large: frame {shot.hero.frame}, {large}. Below: {film}; {frames}"
    return f"""## {shot.name}
![{shot.name}](images/gallery-{shot.name}.webp)

{shot.text}

{told}

![frames of {shot.name}](images/gallery-{shot.name}-sheet.webp)
"""


def how(resolution: tuple[int, int], quality: str) -> str:
    """How a picture is drawn."""
    width, height = resolution
    return f"{width}x{height}, {quality} quality"


def sections_of(page: Path) -> dict[str, str]:
    """The sections of a gallery by the jobs that they are of; none where there is no gallery yet."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    parts = re.split(r"^(?=## )", text, flags=re.MULTILINE)[1:]
    return {part.partition("\n")[0].removeprefix("## "): part.rstrip("\n") + "\n" for part in parts}


def write_page(page: Path, sections: Mapping[str, str]) -> None:
    """All sections under one head, in the order of their names."""
    head = """# Gallery

The jobs of `jobs/`, one after the other. Each can be made with `pipeline submit jobs/NAME.toml`. A section
says what it was drawn on, and stays until its job is drawn again. Seconds are what a stage's tasks took beside all
others; what a frame takes alone is in [rendering](rendering.md#quality-presets). Where not all frames are drawn, they
are from all over what was simulated. Written by `python -m benchmarks.gallery`.
"""
    page.write_text("\n".join([head, *(sections[name] for name in sorted(sections))]), encoding="utf-8")


def figure(seconds: float) -> str:
    """A time in two digits."""
    return f"{seconds:.2g}" if seconds < 10.0 else f"{seconds:.0f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path, help="folder that holds the jobs' folders")
    parser.add_argument("--machine", required=True, help="what they ran on")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/guide"))
    arguments = parser.parse_args()
    page, images = arguments.output / "gallery.md", arguments.output / "images"
    images.mkdir(parents=True, exist_ok=True)
    jobs = sorted(JOBS.glob("*.toml"))
    there = sections_of(page)
    sections = {path.stem: there[path.stem] for path in jobs if path.stem in there}
    drawn = []
    for job_file in jobs:
        layout = JobLayout(arguments.renders / job_file.stem)
        found = shot_of(job_file, layout) if layout.manifest.exists() else None
        if found is None:
            continue
        shot, frames = found
        write_pictures(shot, frames, images)
        sections[shot.name] = section(shot, arguments.machine)
        drawn.append(shot.name)
    write_page(page, sections)
    pictured = [name for name in sorted(sections) if (images / f"gallery-{name}.webp").exists()]
    write_overview([name for name in pictured if name != FIRST], images)
    kept = [name for name in sections if name not in drawn]
    missing = [path.stem for path in jobs if path.stem not in sections]
    for what, names in (("drawn", drawn), ("kept", kept), ("missing", missing)):
        print(f"{what}: {', '.join(names) or 'none'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
