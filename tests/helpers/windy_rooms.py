"""Boxes of air with cloth in them, for the tests of their coupling."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.solver import ClothSolver
from sim.core.domain import DomainParameters
from sim.coupling.smoke_cloth import SmokeClothCoupling
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

AIR_DENSITY = 1.2
SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")
SILENT_SOURCE = {"shape": {"type": "sphere", "radius": 0.05}, "density": 0.0, "start_s": 1.0e3}
WEIGHTLESS = (0.0, 0.0, 0.0)


class WindyRoom:
    """A box of air of 1 and a cloth, which step as the world steps loosely coupled solvers."""

    def __init__(
        self,
        cloths: list[dict[str, Any]],
        *,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        cell_size: float,
        open_faces: tuple[str, ...] = SIDES,
        gravity: tuple[float, float, float] = WEIGHTLESS,
        **smoke: Any,
    ) -> None:
        middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
        keys = {
            "source": [{**SILENT_SOURCE, "position": middle}],
            "min": low,
            "max": high,
            "cell_size": cell_size,
            "open_faces": open_faces,
            "vorticity_confinement": 0.0,
        }
        domain = DomainParameters(min=low, max=high)
        self.smoke = SmokeSolver(
            SmokeParameters.model_validate({"name": "air", **keys, **smoke}), domain=domain, gravity=gravity
        )
        self.cloth = ClothSolver(
            [ClothParameters.model_validate({"air_density": AIR_DENSITY, **each}) for each in cloths],
            domain=domain,
            gravity=gravity,
            frames_per_second=60.0,
        )
        self.coupling = SmokeClothCoupling(self.cloth, self.smoke)
        self.time_s = 0.0
        self._start = (self.cloth.checkpoint(), self.smoke.checkpoint())

    def start_anew(self) -> None:
        """Back to the start, with the parameters as they are now; building another room costs seconds of compiling."""
        for solver, arrays in zip((self.cloth, self.smoke), self._start, strict=True):
            solver.restore(arrays)
            solver.begin_frame(0.0)
        self.coupling.resume()
        self.time_s = 0.0

    def blow(self, *velocity: float | NDArray[np.floating]) -> None:
        """Set the velocity of the faces across x, y and z [m/s], and tell the cloth."""
        grid = self.smoke.grid
        for axis, (field, value) in enumerate(zip(self.faces, velocity, strict=True)):
            values = np.broadcast_to(value, grid.face_shape(axis)).astype(np.float32)
            field.from_numpy(grid.pad(values).ravel())
        self.coupling.resume()

    @property
    def faces(self) -> tuple[Any, Any, Any]:
        return self.smoke.state.velocity

    def velocity(self, axis: int) -> NDArray[np.float64]:
        """Of the faces across an axis [m/s]."""
        return self.smoke.grid.trim(self.faces[axis].to_numpy(), self.smoke.grid.face_shape(axis)).astype(np.float64)

    def step_cloth(self, dt: float) -> NDArray[np.float64]:
        """Several substeps of the cloth; returns the impulse of the air on it [N s]."""
        count = math.ceil(dt / self.cloth.stable_dt() - 1.0e-9)
        impulse = np.zeros(3)
        for _ in range(count):
            self.cloth.substep(dt / count)
            impulse += dt / count * self.cloth.air.force.to_numpy().astype(np.float64).sum(axis=0)
        return impulse

    def step(self, longest: float = 1.0 / 60.0) -> NDArray[np.float64]:
        """One step of the smoke; returns the impulse of the air on the cloth [N s]."""
        dt = min(self.smoke.stable_dt(), longest)
        impulse = self.step_cloth(dt)
        self.coupling.exchange(dt)
        self.smoke.substep(dt)
        self.coupling.follow(dt)
        self.time_s += dt
        return impulse

    def air_momentum(self) -> NDArray[np.float64]:
        """Of all faces, with a cell's mass of air each [kg m/s]."""
        mass = AIR_DENSITY * self.smoke.grid.cell_size**3
        return np.array([mass * self.velocity(axis).sum() for axis in range(3)])

    def kinetic_energy(self) -> float:
        """Of air and cloth [J]."""
        mass = AIR_DENSITY * self.smoke.grid.cell_size**3
        air = sum(0.5 * mass * (self.velocity(axis) ** 2).sum() for axis in range(3))
        cloth = self.cloth.state
        squares = (cloth.velocity.to_numpy().astype(np.float64) ** 2).sum(axis=1)
        return float(air + 0.5 * cloth.mass.to_numpy().astype(np.float64) @ squares)


def sheet(size: float = 0.1, nodes: int = 11, **keys: Any) -> dict[str, Any]:
    """A square across x in the middle of the box that `duct` makes, unless told otherwise."""
    return {
        "name": "sheet",
        "shape": {"type": "rectangle", "size": (size, size), "counts": (nodes, nodes)},
        "rotation_deg": (0.0, 90.0, 0.0),
        "self_collision": False,
        **keys,
    }


def duct(cloth: dict[str, Any], *, length: float = 0.4, width: float = 0.1, cell_size: float = 0.02) -> WindyRoom:
    """A pipe along x around the origin with a cloth all across, whose air moves on beyond both ends as it does inside.

    Ends that are open to air at rest would slow it down as well (test_smoke_open_sides.py), whatever the cloth does.
    """
    room = WindyRoom(
        [cloth],
        low=(-0.5 * length, -0.5 * width, -0.5 * width),
        high=(0.5 * length, 0.5 * width, 0.5 * width),
        cell_size=cell_size,
        open_faces=("x-", "x+"),
    )
    room.smoke._open_sides = ()
    return room
