"""Counters of the iterative solves of a frame."""

import math
from dataclasses import dataclass


@dataclass
class SolveRecord:
    """Counters of the solves of one kind in a frame."""

    solves: int = 0  # their number
    iterations: int = 0  # of all of them
    worst_error: float = 0.0  # largest error with which one ended [-]
    not_converged: int = 0  # number of those that ended before their error was below the tolerance

    def add(self, iterations: int, error: float, *, converged: bool) -> None:
        """Count one solve."""
        self.solves += 1
        self.iterations += iterations
        # A NaN is larger than any number here, and stays.
        if not (error <= self.worst_error or math.isnan(self.worst_error)):
            self.worst_error = error
        self.not_converged += not converged

    def clear(self) -> None:
        """Begin a frame."""
        self.solves = self.iterations = self.not_converged = 0
        self.worst_error = 0.0

    @property
    def mean_iterations(self) -> float:
        """Iterations per solve."""
        return self.iterations / max(self.solves, 1)
