"""Bodies that break, as a job file names them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sim.core.parameters import Parameters, Positive
from sim.shapes.parameters import MOST_PIECES


class BreakParameters(Parameters):
    """How a dynamic body breaks: into which pieces, and at what stress of the faces between them.

    The pieces are bodies of their own, called NAME_1, NAME_2 and so on. As long as they hold together they move as one.
    """

    strength: Positive = Field(
        description="Largest principal stress on a face between pieces that holds [Pa]: some 3e6 of plaster and brick, "
        "1e7 of stone and ceramic, 5e7 of glass."
    )
    pieces: Annotated[int, Field(ge=2, le=MOST_PIECES)] | None = Field(
        default=None,
        description="Number of pieces [-]: Voronoi cells of random points in the shape. If omitted, the parts of a "
        "compound are the pieces.",
    )
    seed: Annotated[int, Field(ge=0)] = Field(default=0, description="Of these points: another number, other pieces.")
    impact_s: Positive = Field(
        default=1.0e-3,
        description="How long a blow lasts [s], which makes a force of its impulse: 1e-4 of what is hard and small, "
        "1e-2 of what is soft or large.",
    )
