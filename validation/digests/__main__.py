"""Digests of every output of six small jobs, to hold two versions of the program against each other.

    python -m validation.digests                       # about three minutes on two cores
    python -m validation.digests pool --output out     # one of them, its folder kept
    python -m validation.digests --frames 12

One line a file, `blake3  job/path`, sorted: `diff` of two versions' outputs names what changed. Together the jobs have
every solver, coupling and stage. On one machine the bytes are the same in every run; processors of another make differ.
"""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import click
from blake3 import blake3

JOBS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}
OUTPUTS = {".h5", ".json", ".ply", ".vdb", ".png", ".exr", ".mp4"}


def outputs(folder: Path) -> Iterator[Path]:
    """Every artifact of a job's folder; what the program keeps for itself lies in hidden folders or has other names."""
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if path.is_file() and path.suffix in OUTPUTS and not hidden and "checkpoints" not in relative.parts:
            yield path


def digest_job(job: Path, output: Path, frames: int) -> Iterator[tuple[str, str]]:
    """Run a job and yield the digest and name of each of its outputs.

    Raises:
        subprocess.CalledProcessError: the job failed.
    """
    command = [sys.executable, "-P", "-m", "pipeline", "submit", str(job), "--farm", str(output)]
    subprocess.run([*command, "--set", f"frames={frames}"], check=True, stdout=sys.stderr)
    folder = output / job.stem
    for path in outputs(folder):
        yield blake3(path.read_bytes()).hexdigest()[:32], path.relative_to(output).as_posix()


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(sorted(JOBS)))
@click.option("--output", type=click.Path(path_type=Path), help="Keep the jobs' folders here.")
@click.option("--frames", default=8, show_default=True, help="Frames of each job.")
def main(names: tuple[str, ...], output: Path | None, frames: int) -> None:
    """Run small jobs, all of them if no NAMES are given, and print digests of their outputs."""
    folder = output or Path(tempfile.mkdtemp(prefix="digests-"))
    try:
        for name in names or sorted(JOBS):
            for digest, path in digest_job(JOBS[name], folder, frames):
                click.echo(f"{digest}  {path}")
    finally:
        if output is None:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
