"""Limits of retries, as the scheduler goes by them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Policy:
    """Limits of retries and of failures.

    Attributes:
        attempts: how often a task is tried when the machine is at fault.
        out_of_memory_attempts: the same, when memory ran out; every retry has the machine for itself.
        backoff_s: pause before the second attempt [s]; doubles with each further one.
        failure_share: a stage in which this share of the ended tasks failed stops the job ...
        failure_count: ... once this many of its tasks failed.
    """

    attempts: int = 3
    out_of_memory_attempts: int = 2
    backoff_s: float = 2.0
    failure_share: float = 0.25
    failure_count: int = 10
