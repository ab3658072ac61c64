"""What the cloth solver lets contacts do: change where nodes end up in a substep."""

from collections.abc import Callable, Mapping
from typing import Protocol

from sim.cloth.state import ClothState


class ClothContacts(Protocol):
    """A kind of contact: of cloths with themselves and each other, with bodies, with walls."""

    def stable_dt(self, state: ClothState, at_most: float) -> float:
        """Largest step [s] for the current state, `at_most` this one."""

    def resolve(self, state: ClothState, dt: float, relax: Callable[[], bool]) -> None:
        """Change the displacements of a step of dt [s], after the springs have; pinned nodes stay as they are.

        Args:
            state: with displacements.
            dt: [s].
            relax: lets the springs change displacements once more where contacts stretched them too much, and says
                whether it did; contacts are resolved again then.
        """

    def begin_frame(self) -> None:
        """Reset the counters of the frame, and forget what a run that continues here would not know."""

    def diagnostics(self) -> Mapping[str, float]:
        """Numbers about the contacts of the frame, by name."""
