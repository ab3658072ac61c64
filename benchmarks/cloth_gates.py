"""Gates that a design of cloth has to pass before a solver is written by it; JSON on the standard output.

    python -m benchmarks.cloth_gates --scene ball --nodes 128 --substeps 20 --frames 120 --device cpu
    python -m benchmarks.cloth_gates --scene twist --nodes 256 --substeps 40 --device cuda --keep twist.npz
    python -m benchmarks.cloth_gates --check twist.npz

A square metre of cotton drapes itself over a ball, crumples in a funnel, or is a column that is twisted at both ends;
the design is that of `benchmarks.cloth_trial`. Told are the crossings of the sheet with itself in every tenth frame, by
exact arithmetic; the worst strain of a spring in each frame, with its median and most over the frames; by how much the
energy rises within a frame at most, in parts of the range that it has been in; the times of frames without the first,
which compiles; and what `benchmarks.cloth_trial.TALLY` counts in a frame.

`--keep` leaves the crossings to `--check`, for machines without SciPy.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.compare import arguments_of, machine, spread, start_taichi

if TYPE_CHECKING:
    from benchmarks.cloth_trial import TrialSheet

FRAMES_BETWEEN_CHECKS = 10


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--scene", choices=("ball", "funnel", "twist"), default="ball")
    parser.add_argument("--nodes", type=int, default=64, help="along a side (default: %(default)s)")
    parser.add_argument("--substeps", type=int, default=20, help="in a frame (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=120, help="default: %(default)s")
    parser.add_argument("--every", type=int, default=4, help="substeps of a list (default: %(default)s)")
    parser.add_argument("--room", type=int, default=200, help="of the list, in pairs a node (default: %(default)s)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no further frame after this time")
    parser.add_argument("--keep", type=Path, help="positions of every tenth frame, instead of their crossings")
    parser.add_argument("--check", type=Path, help="crossings of what was kept, nothing else")
    if (kept := parser.parse_known_args()[0].check) is not None:
        print(json.dumps({"crossings": crossings_in(np.load(kept)["positions"])}))
        return
    arguments = start_taichi(parser)
    print(json.dumps({**machine(arguments.device), **measure(arguments)}, indent=1))


def measure(arguments: Any) -> dict[str, Any]:
    """One run."""
    from benchmarks.cloth_trial import TrialSheet

    sheet = TrialSheet(
        arguments.scene,
        arguments.nodes,
        substeps=arguments.substeps,
        on_gpu=arguments.device == "cuda",
        every=arguments.every,
        room=arguments.room,
    )
    until = time.monotonic() + 60.0 * arguments.minutes
    times: list[float] = []
    strains, energies, kept, tallies = [], [], [], []
    while len(times) < arguments.frames and time.monotonic() < until:
        sheet.begin_frame()
        before = time.perf_counter()
        for _ in range(arguments.substeps):
            sheet.substep()
        positions = sheet.positions()
        times.append(time.perf_counter() - before)
        tallies.append({**sheet.tally, "pairs": sheet.count})
        strains.append(worst_strain(positions, arguments.nodes))
        energies.append(energy(sheet, positions))
        if len(times) % FRAMES_BETWEEN_CHECKS == 0:
            kept.append(positions)
    rises = np.diff(energies).max(initial=0.0) / (max(energies) - min(energies))
    result: dict[str, Any] = {
        "scene": arguments.scene,
        "nodes": arguments.nodes,
        "substeps": arguments.substeps,
        "frames": len(times),
        "frame_ms": spread(times[1:], scale=1e3),
        "strain": {**spread(strains), "of_frame": int(np.argmax(strains)), "of_last": strains[-1]},
        "largest_rise_of_energy": float(rises),
        **{name: {"mean": float(np.mean(each)), "most": int(max(each))} for name, each in transposed(tallies).items()},
    }
    if arguments.keep is not None:
        np.savez_compressed(arguments.keep, positions=np.array(kept))
    else:
        result["crossings"] = crossings_in(kept)
    return result


def transposed(rows: list[dict[str, int]]) -> dict[str, list[int]]:
    """Columns of rows that have the same keys."""
    return {name: [row[name] for row in rows] for name in rows[0]}


def worst_strain(positions: NDArray[np.float32], n: int) -> float:
    """Of a spring of warp or weft [-]."""
    x = positions.astype(np.float64).reshape(n, n, 3)
    lengths = [np.linalg.norm(np.diff(x, axis=axis), axis=2).max() for axis in (0, 1)]
    return float(max(lengths) * (n - 1) - 1.0)


def energy(sheet: TrialSheet, positions: NDArray[np.float32]) -> float:
    """Of motion, height, threads and shears, a kilogram [J/kg]; 2 % of strain hold as much as the height does."""
    from benchmarks.cloth_trial import GRAVITY, SHEAR, SOFT_IN_COMPRESSION, STRETCH

    velocity = sheet.u.to_numpy().astype(np.float64) / sheet.step_s
    x = positions.astype(np.float64).reshape(sheet.n, sheet.n, 3)
    of_springs = 0.0
    for axis in (0, 1):
        longer = np.linalg.norm(np.diff(x, axis=axis), axis=2) - sheet.h
        of_thread = 0.5 * STRETCH * (np.square(longer) / np.where(longer < 0, SOFT_IN_COMPRESSION, 1.0)).sum(axis=axis)
        of_springs += of_thread.sum() - 0.5 * (of_thread[0] + of_thread[-1])
    for across in (x[1:, 1:] - x[:-1, :-1], x[1:, :-1] - x[:-1, 1:]):
        of_springs += 0.5 * SHEAR * np.square(np.linalg.norm(across, axis=2) - 2.0**0.5 * sheet.h).sum()
    of_nodes = 0.5 * np.square(velocity).sum(axis=1) + GRAVITY * positions[:, 2]
    return float(of_nodes.mean() + of_springs * sheet.inverse_mass / sheet.nodes)


def crossings_in(positions: list[NDArray[np.float32]] | NDArray[np.float32]) -> list[int]:
    """How often the sheet passes through itself in each frame that was kept."""
    from validation.crossing_triangles import crossings

    n = round(len(positions[0]) ** 0.5) if len(positions) else 0
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate(
        [np.stack(each, axis=1) for each in ((first, first + 1, first + n + 1), (first, first + n + 1, first + n))]
    )
    return [len(crossings(each, triangles)) for each in positions]


if __name__ == "__main__":
    main()
