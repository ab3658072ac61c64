"""What benchmarks share: JSON, medians, and two checkouts in turns.

    python -m benchmarks.fluid --particles 20000 --against DIR [--turns 5]

This runs the same command here and in another checkout, in turns, so that whatever else the machine does slows both
alike. Printed are the medians here and there, and the median of the ratios within a turn: over 1 is slower here. The
other checkout may be an old one: its own `benchmarks.fluid` prints what this one prints; what it prints beyond that, or
less, is left out.
"""

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
NOISE = 0.03
"""A median ratio above this over 1 is told as slower."""

TIMES = ("_s", "_ms", "_us", "_per_frame", "_bare", "[ms]", "plan", "nothing to do", "submit", "status", "command")
"""How the names of numbers end that are times."""

OF_THE_SCENE = ("dt_s", "simulated_s", "building_s", "first_step_s", "_per_s", "_per_core_s")
"""How the names of those end that are no times of the program, are rates, or mostly the compiling of kernels."""

Numbers = dict[str, float]


# --- what each benchmark uses ----------------------------------------------------------------------------------------


def arguments_of(doc: str | None) -> argparse.ArgumentParser:
    """A command line that tells a benchmark's docstring."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def start_taichi(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The arguments, with `--device` and `--threads`, on which Taichi is started; `device` is what was found."""
    from sim.core.runtime import initialize

    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    arguments.device = initialize(arguments.device, threads=arguments.threads)
    return arguments


def machine(device: str = "cpu") -> dict[str, Any]:
    """What numbers depend on besides the code."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"device": device, "cores": cores, "load_average": round(os.getloadavg()[0], 2)}


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor time of a call [s]; the latter is that of all threads, which other programs do not enter."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def array_bytes() -> int:
    """What all arrays take on the device."""
    import taichi as ti

    gc.collect()
    arrays = (found.arr for found in gc.get_objects() if isinstance(found, ti.Ndarray))
    return sum(array.nelement() * array.element_size() for array in arrays)


def spread(values: Sequence[float], *, scale: float = 1.0) -> dict[str, float]:
    """Median, least and most, times a scale."""
    return {name: scale * of(values) for name, of in (("median", statistics.median), ("least", min), ("most", max))}


def child(command: Sequence[str], **how: Any) -> Any:
    """The JSON that a Python process prints, whose libraries write elsewhere: see `keep_output_for_json`.

    Raises:
        subprocess.CalledProcessError: the process failed.
        ValueError: what it printed is no JSON.
    """
    command = [sys.executable, *command]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, **how).stdout)


def keep_output_for_json() -> None:
    """From now on only what this program prints gets to the standard output; libraries write to the standard error."""
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)


def run(main: Callable[[], object]) -> None:
    """Run a benchmark's main and print the JSON of what it returns; with `--against DIR`, in turns with another's."""
    if "--against" in sys.argv:
        own = argparse.ArgumentParser(add_help=False)
        own.add_argument("--against", type=Path, required=True)
        own.add_argument("--turns", type=int, default=5)
        chosen, others = own.parse_known_args()
        spec = sys.modules["__main__"].__spec__
        assert spec is not None
        name = spec.name.rpartition(".")[2]
        turns = take_turns(lambda tree: benchmark(tree, name, *others), chosen.against.resolve(), chosen.turns)
        print(table({name: turns}))
        return
    keep_output_for_json()
    if (result := main()) is not None:
        print(json.dumps(result, indent=1))


# --- two checkouts ---------------------------------------------------------------------------------------------------


def environment(tree: Path) -> dict[str, str]:
    """That of a process which is to import a checkout's packages."""
    return {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": ""}


def benchmark(tree: Path, name: str, *arguments: str) -> Numbers:
    """The times that a checkout's own benchmark tells."""
    return dict(times_in(child(["-m", f"benchmarks.{name}", *arguments], cwd=tree, env=environment(tree))))


def times_in(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number in JSON that is a time, by its path; of a spread the median; pairs are wall and processor time."""
    if isinstance(value, Mapping):
        if "median" in value and "least" in value:
            value = value["median"]
        else:
            for key, each in value.items():
                yield from times_in(each, f"{path}/{key}" if path else str(key))
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for number, each in enumerate(value):
            yield from times_in(each, f"{path}/{number}" if path else str(number))
    elif isinstance(value, list) and len(value) == 2 and path.endswith(TIMES):
        yield f"{path}, processor", float(value[1])
        value = value[0]
    stem = path.removesuffix("_median").removesuffix("_min")
    if isinstance(value, int | float) and stem.endswith(TIMES) and not stem.endswith(OF_THE_SCENE):
        yield path, float(value)


def take_turns(measure: Callable[[Path], Numbers], other: Path, turns: int) -> list[tuple[Numbers, Numbers]]:
    """What is measured here and in another checkout, turn by turn, after one of each that warms up."""
    pairs = []
    for turn in range(turns + 1):
        order = (HERE, other) if turn % 2 else (other, HERE)
        found = {tree: measure(tree) for tree in order}
        pairs.append((found[HERE], found[other]))
    return pairs[1:]


def ratios(turns: Sequence[tuple[Numbers, Numbers]]) -> dict[str, tuple[float, float, float]]:
    """Medians here and there, and of the ratios within a turn, of what both tell in every turn."""
    names = [
        name for name in turns[0][0] if all(name in numbers and numbers[name] > 0 for pair in turns for numbers in pair)
    ]
    return {
        name: (
            statistics.median(here[name] for here, _ in turns),
            statistics.median(there[name] for _, there in turns),
            statistics.median(here[name] / there[name] for here, there in turns),
        )
        for name in names
    }


def table(measured: Mapping[str, Sequence[tuple[Numbers, Numbers]]]) -> str:
    """A Markdown table of what was measured, by benchmark."""
    lines = ["| benchmark | here | there | ratio | |", "|---|---|---|---|---|"]
    for benchmark_name, turns in measured.items():
        for name, (here, there, ratio) in ratios(turns).items():
            verdict = "slower" if ratio > 1.0 + NOISE else "faster" if ratio < 1.0 - NOISE else ""
            lines.append(f"| {benchmark_name}: {name} | {here:.4g} | {there:.4g} | {ratio:.3f} | {verdict} |")
    return "\n".join(lines)
