"""Boxes of air with water in them, for the tests of their coupling."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.coupling.smoke_fluid import SmokeFluidCoupling
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
from sim.fluid.parameters import FluidParameters
from sim.fluid.solvers import SOLVERS
from sim.fluid.tank import FluidStart
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

SPACING = 0.02
WEIGHTLESS = (0.0, 0.0, 0.0)
SILENT_SOURCE = {"shape": {"type": "sphere", "radius": 0.05}, "density": 0.0, "start_s": 1.0e3}


class HalfFullRoom:
    """A box of air and water, which step as the world steps loosely coupled solvers."""

    def __init__(
        self,
        water: NDArray[np.floating],
        *,
        domain: DomainParameters,
        cell_size: float,
        velocity: tuple[float, float, float] = WEIGHTLESS,
        air_gravity: tuple[float, float, float] = WEIGHTLESS,
        source: dict[str, Any] | None = None,
        **smoke: Any,
    ) -> None:
        """Weightless particles at `water`, (n, 3), all of one velocity; by default the smoke fills the domain."""
        fluid = FluidParameters.model_validate(
            {"name": "water", "block": [{"shape": {"type": "box", "size": (1, 1, 1)}}], "particle_radius": SPACING / 2}
        )
        start = FluidStart(
            (fluid,),
            domain=domain,
            gravity=WEIGHTLESS,
            positions=water.astype(np.float32),
            velocities=np.broadcast_to(np.float32(velocity), water.shape).copy(),
            boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, SPACING, fluid.support_in_spacings)),
            capacity=10_000,
        )
        self.fluid = SOLVERS[fluid.solver](start)
        middle = tuple(0.5 * (a + b) for a, b in zip(domain.min, domain.max, strict=True))
        keys = {"cell_size": cell_size, "open_faces": (), "vorticity_confinement": 0.0, **smoke}
        self.smoke = SmokeSolver(
            SmokeParameters.model_validate(
                {"name": "air", "source": [source or {**SILENT_SOURCE, "position": middle}], **keys}
            ),
            domain=domain,
            gravity=air_gravity,
            moving=True,
        )
        self.coupling = SmokeFluidCoupling(self.fluid, self.smoke, domain=domain)
        self.smoke.move_obstacles()

    def place(self, water: NDArray[np.floating]) -> None:
        """Put water at rest there instead; another room would cost seconds of compiling."""
        count = len(water)
        self.fluid.particles.load(
            {
                "position": water.astype(np.float32),
                "velocity": np.zeros((count, 3), np.float32),
                "particle_id": np.arange(count, dtype=np.int32),
                "phase": np.zeros(count, np.int32),
            }
        )
        self.coupling.exchange(0.0)
        self.smoke.move_obstacles()

    def step(self, longest: float = 1.0 / 60.0, *, still: bool = False) -> float:
        """Steps of the fluid, unless it stands still, up to the end of one of the smoke; returns its length [s]."""
        dt = min(self.smoke.stable_dt(), longest)
        elapsed = dt if still else 0.0
        while elapsed < dt:
            part = min(self.fluid.stable_dt(), dt - elapsed)
            self.fluid.substep(part)
            elapsed += part
        self.coupling.exchange(dt)
        self.smoke.substep(dt)
        self.coupling.follow(dt)
        return dt

    def is_water(self) -> NDArray[np.bool_]:
        """Of the cells: whether more than half of them is water."""
        return self.smoke.obstacles.open_volume() < 0.5

    def faces(self, axis: int) -> NDArray[np.float64]:
        """Velocity of the faces across an axis [m/s]."""
        field = self.smoke.state.velocity[axis]
        return self.smoke.grid.trim(field.to_numpy(), self.smoke.grid.face_shape(axis)).astype(np.float64)


def lattice(low: tuple[float, ...], high: tuple[float, ...]) -> NDArray[np.float64]:
    """Particles that fill a box."""
    axes = [np.arange(a + SPACING / 2, b - SPACING / 4, SPACING) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
