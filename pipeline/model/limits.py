"""Limits of a stage's tasks, as a job file names them: `[limits.render]`. They decide no output."""

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from pipeline.base.task import Policy
from render.parameters import Fraction, Parameters, Positive

DEFAULT_STALL_S = 3600.0
"""Cycles shows no sign of life within a frame, and a final one takes half an hour on a few cores."""


class LimitParameters(Parameters):
    """Limits of time, memory and attempts of a stage's tasks; they change no output."""

    timeout_s: Positive | None = Field(
        default=None,
        description="Longest time that one try of a task may take [s]; no limit if omitted, as long as it shows life.",
    )
    stall_s: Positive = Field(
        default=DEFAULT_STALL_S,
        description="Longest time without a sign of life [s]: a simulation gives one a frame, a picture when done.",
    )
    memory_gb: Positive | None = Field(
        default=None,
        description="Most memory that a task's processes may hold together [GB]; 0.9 of the machine's if omitted.",
    )
    attempts: Annotated[int, Field(ge=1)] = Field(
        default=Policy().attempts, description="How often a task is tried when the machine is at fault [-]."
    )
    failure_share: Fraction = Field(
        default=Policy().failure_share,
        description="The job stops when this share of the stage's ended tasks failed [-] ...",
    )
    failure_count: Annotated[int, Field(ge=1)] = Field(
        default=Policy().failure_count, description="... once this many of them failed [-]."
    )

    def policy(self, base: Policy) -> Policy:
        """Policy of the scheduler for this stage; pauses are those of `base`."""
        return replace(
            base,
            attempts=self.attempts,
            out_of_memory_attempts=min(base.out_of_memory_attempts, self.attempts),
            failure_share=self.failure_share,
            failure_count=self.failure_count,
        )

    @property
    def memory_bytes(self) -> int | None:
        """`memory_gb` in bytes."""
        return None if self.memory_gb is None else int(self.memory_gb * 1e9)
