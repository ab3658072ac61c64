"""What accelerates the air of a smoke besides its own weight and heat."""

from __future__ import annotations

from typing import Protocol


class AirForce(Protocol):
    """Something in the air that pushes it, such as cloth."""

    def stable_dt(self) -> float:
        """Largest step [s] that it bears."""

    def accelerate(self, dt: float) -> None:
        """Add what it gives in a step of dt [s] to the velocities of open faces, after the air was carried along."""
