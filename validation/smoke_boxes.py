"""What the cases of smoke share: boxes of air at rest, their faces set to a flow, and norms of what came out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.smoke.parameters import SmokeParameters
from validation.scenes import EARTH, GRAVITY, WEIGHTLESS

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

Advection = Literal["maccormack", "semi_lagrangian"]
Array = NDArray[np.float64]
Flow = Callable[[Array], Array]
"""Velocities [m/s], (n, 3), at positions [m], (n, 3)."""

AMBIENT = 293.0  # temperature of the air [K]

FACES = ("u_face_x", "v_face_y", "w_face_z")
NEVER_S = 1.0e6  # when a source starts that must not emit: a smoke has one at least [s]


def build_box(
    cells: tuple[int, int, int],
    cell_size: float,
    *,
    advection: Advection = "maccormack",
    gravity: tuple[float, float, float] = WEIGHTLESS,
    solids: Sequence[Any] = (),
    **keys: Any,
) -> SmokeSolver:
    """Air in a closed box at the origin; nothing emits, cools or spins it up but what `keys` say."""
    from sim.smoke.solver import SmokeSolver

    size = tuple(n * cell_size for n in cells)
    middle = tuple(0.5 * edge for edge in size)
    idle = {"shape": {"type": "box", "size": size}, "position": middle, "start_s": NEVER_S}
    box = {"name": "air", "min": (0.0, 0.0, 0.0), "max": size, "cell_size": cell_size, "source": [idle]}
    still = {"open_faces": (), "vorticity_confinement": 0.0, "cooling": 0.0, "advection": advection}
    parameters = {**box, **still, **keys}
    return SmokeSolver(
        SmokeParameters.model_validate(parameters), domain=DomainParameters(), gravity=gravity, solids=solids
    )


def warm_box(n: int, advection: Advection, *, height: float = 1.0, **keys: Any) -> SmokeSolver:
    """Air whose warm parts rise, in a box of a metre, n cells across and closed unless `keys` say otherwise."""
    cells, buoyancy = (n, n, round(height * n)), {"buoyancy_temperature": GRAVITY / AMBIENT}
    return build_box(cells, 1.0 / n, advection=advection, gravity=EARTH, **buoyancy, **keys)


def ball_source(height: float, radius: float, warmer: float, end: float) -> dict[str, Any]:
    """A ball that emits evenly until some time [s], so high over the middle of the floor and so much warmer [K]."""
    ball = {"shape": {"type": "sphere", "radius": radius}, "position": (0.5, 0.5, height)}
    return {**ball, "fluctuation": 0.0, "temperature": AMBIENT + warmer, "end_s": end}


def set_flow(solver: SmokeSolver, flow: Flow, **cell_fields: Array) -> None:
    """Start from a flow, sampled at the middles of faces, 0 on closed ones, and from given cell fields, else from 0."""
    grid = solver.grid
    state = {name: np.zeros_like(array) for name, array in solver.checkpoint().items()}
    for axis, name in enumerate(FACES):
        speed = flow(grid.face_centres(axis))[:, axis].reshape(grid.face_shape(axis))
        state[name] = grid.pad((speed * (grid.open_area[axis] > 0.0)).astype(np.float32))
    for name, values in cell_fields.items():
        state[name] = grid.pad(values.reshape(grid.cells).astype(np.float32))
    solver.restore(state)
    solver.begin_frame(0.0)


def faces_of(solver: SmokeSolver) -> list[Array]:
    """Face velocities [m/s] by axis, `face_shape(axis)`."""
    state = solver.checkpoint()
    return [
        solver.grid.trim(state[name], solver.grid.face_shape(axis)).astype(np.float64)
        for axis, name in enumerate(FACES)
    ]


def rms_error(solver: SmokeSolver, flow: Flow) -> float:
    """Root mean square over all faces of what the velocity differs from a flow by [m/s]."""
    total, count = 0.0, 0
    for axis, face in enumerate(faces_of(solver)):
        exact = flow(solver.grid.face_centres(axis))[:, axis].reshape(face.shape)
        total += float(((face - exact) ** 2).sum())
        count += face.size
    return float(np.sqrt(total / count))


def kinetic_energy(solver: SmokeSolver, *, layers: slice = slice(None)) -> float:
    """Half the integral of u² in chosen layers of z [m^5/s²]: each cell gets half of the squares on its faces."""
    u, v, w = (face**2 for face in faces_of(solver))
    cells = 0.25 * (u[1:] + u[:-1] + v[:, 1:] + v[:, :-1] + w[:, :, 1:] + w[:, :, :-1])
    return float(cells[:, :, layers].sum()) * solver.grid.cell_size**3


def take_steps(solver: SmokeSolver, duration: float, count: int) -> None:
    """Advance by a duration [s] in so many equal steps."""
    for _ in range(count):
        solver.substep(duration / count)
