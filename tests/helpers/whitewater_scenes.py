"""Small fluids and clouds that the whitewater tests share."""

from __future__ import annotations

import numpy as np

from sim.core.domain import DomainParameters
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.motion import FluidState
from sim.whitewater.parameters import WhitewaterParameters
from sim.whitewater.solver import WhitewaterSolver

FPS = 60.0
RADIUS = 0.01
SPACING = 2.0 * RADIUS
GRAVITY = (0.0, 0.0, -9.81)
ALL_FACES = ("x-", "x+", "y-", "y+", "z-", "z+")
BOX = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
SILENT = WhitewaterParameters(trapped_air_rate=0.0, wave_crest_rate=0.0)
"""Makes no particles of its own."""


def lattice(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    """Particles of a box at rest [m], (n, 3), float32."""
    axes = [np.arange(a + RADIUS, b, SPACING) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def fluid(position: np.ndarray, velocity: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FluidState:
    velocities = np.broadcast_to(np.asarray(velocity, np.float32), position.shape).copy()
    return FluidState(np.arange(len(position), dtype=np.int32), position.astype(np.float32), velocities)


NO_FLUID = fluid(np.zeros((0, 3), np.float32))


def cloud(position, velocity=(0.0, 0.0, 0.0), *, kind=WhitewaterKind.SPRAY, lifetime: float = 10.0) -> WhitewaterCloud:
    points = np.atleast_2d(np.asarray(position, np.float32))
    return WhitewaterCloud(
        position=points,
        velocity=np.broadcast_to(np.asarray(velocity, np.float32), points.shape).copy(),
        radius=np.full(len(points), 0.002, np.float32),
        lifetime=np.full(len(points), lifetime, np.float32),
        kind=np.full(len(points), kind, np.uint8),
    )


def solver(
    parameters: WhitewaterParameters = SILENT, *, domain: DomainParameters = BOX, gravity=GRAVITY
) -> WhitewaterSolver:
    return WhitewaterSolver(parameters, domain=domain, gravity=gravity, frames_per_second=FPS)


def jets() -> tuple[FluidState, FluidState]:
    """Two jets that are about to meet at 4 m/s, at one frame and the next."""
    left = lattice((-0.2, -0.06, 0.4), (-0.005, 0.06, 0.52))
    right = left * np.array([-1, 1, 1], np.float32)
    position = np.concatenate([left, right])
    velocity = np.zeros_like(position)
    velocity[: len(left), 0], velocity[len(left) :, 0] = 2.0, -2.0
    begin = fluid(position, velocity)
    return begin, FluidState(begin.particle_id, position + velocity / np.float32(FPS), velocity)
