"""How long commands take that do next to nothing: wall times of whole processes, JSON on the standard output.

    python -m benchmarks.start_up [--repeats 9] [--against DIR]

`help` is `pipeline --help`, `plan` that of a small job that has been submitted, and `status` of what this made.
Milliseconds; medians of the repeats, after one of each that warms the file system.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.compare import arguments_of, run

JOB = """
name = "nothing"
frames = 3
device = "cpu"
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
kind = "dynamic"
density = 500.0
[render]
resolution = [64, 36]
quality = "draft"
samples = 1
"""
COMMANDS = {"help": ("--help",), "plan": ("plan", "nothing.toml"), "status": ("status", "nothing")}


def milliseconds(arguments: tuple[str, ...], folder: Path, *, check: bool = True) -> float:
    """Wall time of one command."""
    begin = time.perf_counter()
    command = [sys.executable, "-P", "-m", "pipeline", *arguments]
    subprocess.run(command, cwd=folder, check=check, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return 1e3 * (time.perf_counter() - begin)


def measure(repeats: int) -> dict[str, float]:
    """Medians, the commands in turns."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "nothing.toml").write_text(JOB)
        milliseconds(("submit", "nothing.toml"), folder, check=False)  # without a Blender it is planned at least
        rounds = [{each: milliseconds(how, folder) for each, how in COMMANDS.items()} for _ in range(repeats + 1)]
    return {f"{each}_ms": round(statistics.median(times[each] for times in rounds[1:]), 1) for each in COMMANDS}


def main() -> dict[str, float]:
    parser = arguments_of(__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    return measure(parser.parse_args().repeats)


if __name__ == "__main__":
    run(main)
