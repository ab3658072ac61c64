"""Spoils mesh files in thousands of ways, and lists what becomes of them.

    python tests/helpers/fuzz_meshes.py --seed 1 --count 2000

A small closed mesh is written in every format that jobs may name; bytes of the files are changed, cut, doubled, and
numbers of their headers made huge. Promised are for each: a solid or one sentence, in 2 s, and no 500 MB more than
before. Exits with 1 if a promise was broken.
"""

import argparse
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import trimesh

from sim.shapes.mesh_file import FORMATS, load_mesh_solid, read_texture_coordinates
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import ShapeError

LONGEST_S, MOST_BYTES = 2.0, 500e6
NUMBERS = (b"-1", b"0", b"1e400", b"nan", b"4000000000", b"9" * 400, b"\xff\xff\xff\xff", b"x", b"", b"\x1b[2J")


def flip(content: bytes, generator: random.Random) -> bytes:
    """Some bytes are others."""
    spoilt = bytearray(content)
    for _ in range(generator.randint(1, 20)):
        spoilt[generator.randrange(len(spoilt))] = generator.randrange(256)
    return bytes(spoilt)


def cut(content: bytes, generator: random.Random) -> bytes:
    """The end is missing."""
    return content[: generator.randrange(len(content))]


def double(content: bytes, generator: random.Random) -> bytes:
    """A piece is there twice, or many times."""
    start, end = sorted(generator.choices(range(len(content)), k=2))
    return content[:end] + content[start:end] * generator.choice([1, 2, 50]) + content[end:]


def renumber(content: bytes, generator: random.Random) -> bytes:
    """A number, most often of the header, is one that no mesh has."""
    reach = content[:400] if generator.random() < 0.7 else content
    places = [at for at, byte in enumerate(reach) if 48 <= byte < 58 or byte == 0] or [0]
    at = generator.choice(places)
    return content[:at] + generator.choice(NUMBERS) + content[at + generator.choice([1, 4]) :]


MUTATIONS: tuple[Callable[[bytes, random.Random], bytes], ...] = (flip, cut, double, renumber)


@dataclass
class Report:
    """What became of the files."""

    accepted: int = 0
    refused: int = 0
    broken: list[str] = field(default_factory=list)
    by_mutation: Counter[str] = field(default_factory=Counter)
    longest_s: float = 0.0
    grown_bytes: float = 0.0


def fuzz(seed: int, count: int, folder: Path) -> Report:
    """Read so many spoilt files, each by its own number of the seed."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    whole = {kind: mesh.export(file_type=kind) for kind in FORMATS}
    samples = {kind: text.encode() if isinstance(text, str) else text for kind, text in whole.items()}
    report, before = Report(), _peak_bytes()
    for number in range(count):
        generator = random.Random(f"{seed}/{number}")
        kind, mutation = generator.choice(FORMATS), generator.choice(MUTATIONS)
        path = folder / f"spoilt.{kind}"
        path.write_bytes(mutation(samples[kind], generator))
        report.by_mutation[mutation.__name__] += 1
        shape, began = MeshShape(type="mesh", file=str(path)), time.process_time()
        what = f"seed {seed}, mutation {number} ({mutation.__name__} of {kind})"
        try:
            load_mesh_solid(shape)
            read_texture_coordinates(shape)
            report.accepted += 1
        except ShapeError as error:
            report.refused += 1
            if "\n" in str(error):
                report.broken.append(f"{what}: more than a line: {error!r:.300}")
        except Exception as error:
            report.broken.append(f"{what}: {error!r:.300}")
        took_s = time.process_time() - began
        report.longest_s = max(report.longest_s, took_s)
        if took_s > LONGEST_S:
            report.broken.append(f"{what}: took {took_s:.1f} s")
        report.grown_bytes = _peak_bytes() - before
        if report.grown_bytes > MOST_BYTES:
            report.broken.append(f"{what}: memory grew by {report.grown_bytes / 1e6:.0f} MB")
            break
    return report


def _peak_bytes() -> float:
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=2000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = fuzz(options.seed, options.count, Path(folder))
    print(*report.broken, sep="\n")
    print(
        f"{options.count} meshes: {report.accepted} taken, {report.refused} refused, {len(report.broken)} broken; "
        f"longest {report.longest_s:.2f} s, memory grew by {report.grown_bytes / 1e6:.0f} MB"
    )
    sys.exit(bool(report.broken))


if __name__ == "__main__":
    main()
