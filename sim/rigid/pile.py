"""Contacts of many bodies, solved where they are: on the device, islands or, on GPUs, pairs in colours side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.host_access import copied, put, viewed
from sim.core.reductions import runs_on_gpu
from sim.core.scheduling import LEAST_RUN
from sim.rigid import pile_kernels as kernels
from sim.rigid.collision import CollisionDetector
from sim.rigid.contact_solver import FEWEST_ITERATIONS, MAX_ITERATIONS
from sim.rigid.contacts import Array
from sim.rigid.tables import kept, larger

LOOKS = tuple((0, *range(least, MAX_ITERATIONS + 1, 4)) for least in (FEWEST_ITERATIONS, FEWEST_ITERATIONS // 2))
"""Sweeps of both solves before which the device is asked whether any island is not done."""


class Pile:
    """Solves the contacts that a detector has found last, where nothing bounces and no joint holds.

    Attributes:
        touched: 1 of bodies that got an impulse, 3 if something that cannot move gave it, (n + 1,).
        sweeps: of the island that took most, in both solves together.
        converged: whether all islands did that may take all sweeps.
    """

    def __init__(self, detector: CollisionDetector, moving: int, *, in_colours: bool) -> None:
        """Take so many bodies that move; islands are solved by a thread each unless their pairs get colours."""
        self._detector, self._rows, self._in_colours = detector, moving + 1, in_colours
        self._of_bodies: dict[str, Any] | None = None
        self._work: ti.Ndarray | None = None
        self._colours: ti.Ndarray | None = None
        self._pairs: ti.Ndarray | None = None
        self._by_rank: ti.Ndarray | None = None
        self.sweeps, self.converged = 0, True
        self.touched = np.zeros(moving + 1, dtype=np.int32)

    def solve(self, ease: Array, velocity: Array, friction: Array, limits: kernels.Limits) -> tuple[Array, Array]:
        """Velocities (v, omega) of all bodies, and those that only move them apart [m/s], [rad/s], (n + 1, 6) each.

        Args:
            ease: as `ContactSystem.ease`.
            velocity: without contacts, (n + 1, 6).
            friction: of all bodies, (b,).
            limits: when it ends.
        """
        near, contacts, bodies, placed = self._detector.on_device()
        count, pile = self._detector.pair_count, self._tables(near, placed, len(friction))
        put(pile.ease, ease)
        put(pile.velocity, velocity)
        put(pile.friction, np.append(friction, -1.0))
        kernels.begin_pile(count, near, contacts, pile)
        where = (near, contacts, bodies, placed, pile, limits)
        if self._in_colours:
            self._solve_in_colours(count, *where)
        else:
            islands = kernels.sort_islands(count, near, contacts, pile, limits)
            kernels.solve_islands(islands, 1 if runs_on_gpu() else LEAST_RUN, *where)
        islands: NDArray[np.int64] = viewed(pile.islands)
        taken, most = islands[:, kernels.TAKEN : kernels.TAKEN + 2], islands[:, kernels.MOST]
        self.sweeps = int(np.minimum(taken, limits.most).max(axis=0).sum())
        self.converged = bool(np.all((taken <= most[:, None]) | (most[:, None] < limits.most)))
        self.touched = viewed(pile.touched).astype(np.int32)
        return viewed(pile.velocity).copy(), viewed(pile.extra).copy()

    def _solve_in_colours(
        self, count: int, near: Any, contacts: Any, bodies: Any, placed: Any, pile: Any, limits: kernels.Limits
    ) -> None:
        while kernels.colour_pairs(count, near, contacts, pile):
            pass
        total = kernels.sort_pairs(count, near, contacts, pile, limits)
        kernels.gather_pile(total, near, contacts, bodies, placed, pile, limits)
        colours = int(copied(pile.turn)[2])
        kernels.start_colour.repeat(colours, near, contacts, pile)
        for solve in range(2):
            for sweep in range(limits.most + 1):
                kernels.begin_sweeps(solve, sweep, pile, limits, self._alive)
                if sweep in LOOKS[solve] and not copied(self._alive)[solve, sweep]:
                    break
                kernels.relax_colour.repeat(colours, solve, near, contacts, pile)
            if solve == 0:
                kernels.finish_pairs(total, near, contacts, placed, pile, limits)

    def _tables(self, near: Any, placed: Any, bodies: int) -> kernels.Pile:
        if self._of_bodies is None:
            six, seven, twelve = (ti.types.vector(size, ti.f64) for size in (6, 7, 12))
            rows = self._rows
            self._of_bodies = {
                "first": ti.ndarray(ti.i32, kernels.COLOURS + 1),
                "turn": ti.ndarray(ti.i32, 3),
                "places": ti.ndarray(ti.i32, kernels.COLOURS),
                "least": ti.ndarray(ti.i32, rows),
                "masks": ti.ndarray(ti.i32, rows),
                "group": ti.ndarray(ti.i32, rows),
                "roots": ti.ndarray(ti.i32, rows),
                "movers": ti.ndarray(ti.i32, rows),
                "spans": ti.ndarray(ti.i32, (rows + 1, 2)),
                "vacant": ti.ndarray(ti.i32, (rows, 2)),
                "islands": ti.ndarray(ti.i64, (rows, kernels.ISLAND_COLUMNS)),
                "done": ti.ndarray(ti.i32, (rows, 2)),
                "ratios": ti.ndarray(ti.f64, rows),
                "ease": ti.ndarray(seven, rows),
                "friction": kept(np.zeros(bodies + 1)),
                "velocity": ti.ndarray(six, rows),
                "extra": ti.ndarray(six, rows),
                "ahead": ti.ndarray(twelve, rows),
                "touched": ti.ndarray(ti.i32, rows),
            }
            self._alive = ti.ndarray(ti.i32, (2, kernels.MOST_SWEEPS + 1))
        length = near.pairs.shape[0]
        self._colours = larger(self._colours, (length,), ti.i32)
        self._pairs = larger(self._pairs, (length,), ti.i32)
        self._by_rank = larger(self._by_rank, (length,), ti.i32)
        self._work = larger(self._work, (placed.gap.shape[0],), ti.types.vector(kernels.WORK_COLUMNS, ti.f64))
        return kernels.Pile(
            colour=self._colours, pairs=self._pairs, by_rank=self._by_rank, work=self._work, **self._of_bodies
        )
