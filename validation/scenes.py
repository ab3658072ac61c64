"""Builds what the cases of fluids and rigid bodies compute, with any of the solvers, and steps it as a film would."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.core.domain import DomainParameters
from sim.rigid.parameters import RigidBodyParameters

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.rigid.solver import RigidSolver


GRAVITY, WATER = 9.81, 1000.0  # [m/s²], and the density of water [kg/m³]

EARTH, WEIGHTLESS = (0.0, 0.0, -GRAVITY), (0.0, 0.0, 0.0)
EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")
HALL = DomainParameters(min=(-5.0, -5.0, 0.0), max=(5.0, 5.0, 10.0))

SPACING = 0.02  # of the particles around bodies that are validated in water [m]
SIDE_IN_RADII = 6.0  # of the tank with a sphere in it, and the depth of its water

Vectors = NDArray[np.float32]
Curve = NDArray[np.float64]


class Steppable(Protocol):
    """A solver, or several that step together."""

    def stable_dt(self) -> float:
        """Largest step [s] for the state as it is."""

    def substep(self, dt: float) -> None:
        """Step by dt [s]."""

    def first_bad_quantity(self) -> str | None:
        """What is not finite or runs away; None where all is well."""


def steps(solver: Steppable, duration: float) -> Iterator[float]:
    """Take steps that land on a duration [s], as a frame's do; yields the length of each after it was taken [s].

    Raises:
        RuntimeError: the state is not finite or runs away.
    """
    remaining = duration
    while remaining > 0.0:
        left = max(1, math.ceil(remaining / solver.stable_dt() * (1.0 - 1.0e-9)))
        dt = remaining / left
        remaining = remaining - dt if left > 1 else 0.0
        solver.substep(dt)
        yield dt
    if (quantity := solver.first_bad_quantity()) is not None:
        raise RuntimeError(f"{type(solver).__name__} diverged: {quantity}")


def advance(solver: Steppable, duration: float, *, cuts: int = 1) -> Iterator[float]:
    """Advance by a duration [s] and stop after each of so many equal parts of it; yields the time [s].

    Raises:
        RuntimeError: the state is not finite or runs away.
    """
    part = duration / cuts
    for cut in range(1, cuts + 1):
        for _ in steps(solver, part):
            pass
        yield cut * part


def recorded(
    solver: Steppable, duration: float, *, cuts: int, start: bool = False, **quantities: Callable[[], float]
) -> dict[str, list[float]]:
    """Quantities after each of so many equal parts of a duration [s], and `times` [s]; with those at the start."""
    found: dict[str, list[float]] = {name: [] for name in ("times", *quantities)}
    for time in chain([0.0] if start else [], advance(solver, duration, cuts=cuts)):
        found["times"].append(time)
        for name, quantity in quantities.items():
            found[name].append(float(quantity()))
    return found


def lattice(low: Sequence[float], high: Sequence[float], spacing: float) -> Vectors:
    """Cubic lattice that fills a box, half a spacing from its faces, (n, 3) [m]."""
    counts = [round((b - a) / spacing) for a, b in zip(low, high, strict=True)]
    axes = [a + spacing * (np.arange(count) + 0.5) for a, count in zip(low, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def turn_about_y(angle_deg: float) -> Curve:
    """Matrix that turns rows of positions about y, (3, 3)."""
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def make_fluid(
    solver: str,
    domain: DomainParameters,
    positions: Vectors,
    *,
    spacing: float,
    velocities: NDArray[np.floating] | None = None,
    gravity: tuple[float, float, float] = EARTH,
    coupled: Mapping[str, Any] | None = None,
    fluids: Sequence[Mapping[str, Any]] = ({},),
    **parameters: Any,
) -> SPHFluid:
    """A fluid of given particles between the walls of a domain, at rest without velocities; no tension unless given.

    `coupled` are further fields of `FluidStart`, `parameters` those of a material other than water, and `fluids` what
    each of several has of its own.
    """
    from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
    from sim.fluid.parameters import FluidParameters
    from sim.fluid.solvers import SOLVERS
    from sim.fluid.tank import FluidStart

    block = {"shape": {"type": "box", "size": (1.0, 1.0, 1.0)}}
    usual = {
        "name": "water",
        "solver": solver,
        "block": [block],
        "particle_radius": spacing / 2.0,
        "surface_tension": 0.0,
    }
    start = FluidStart(
        tuple(FluidParameters.model_validate({**usual, **parameters, **each}) for each in fluids),
        domain=domain,
        gravity=gravity,
        positions=positions,
        velocities=np.zeros_like(positions) if velocities is None else velocities.astype(np.float32),
        boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, spacing)),
        **(coupled or {}),
    )
    return SOLVERS[solver](start)


def state_of(fluid: SPHFluid) -> tuple[Curve, Curve]:
    """Positions [m] and velocities [m/s] by particle id, (n, 3) each, float64."""
    arrays = next(iter(fluid.snapshots().values())).arrays
    return arrays["position"].astype(np.float64), arrays["velocity"].astype(np.float64)


def wall_forces(fluid: SPHFluid) -> tuple[Curve, Curve]:
    """Samples of walls [m], and the pressure force on each, f_b = sum_i V V_b P_i grad_i W_ib [N], (m, 3) each."""
    from sim.fluid.kernels import evaluate_slope

    fluid.compute_density()
    particles, samples, fixed = fluid.particles, fluid.boundary.samples, slice(fluid.boundary.fixed_count)
    x_b, volume = (array.to_numpy()[fixed].astype(np.float64) for array in (samples.position, samples.volume))
    x_i, pressure = (particles.host(array).astype(np.float64) for array in (particles.position, fluid.pressure_term))
    support = fluid.discretization.support_radius
    near = cKDTree(x_b).sparse_distance_matrix(cKDTree(x_i), support, output_type="coo_matrix")
    b, i, distance = near.row, near.col, near.data
    strength = fluid.particle_volume * volume[b] * pressure[i] * evaluate_slope(distance, support) / distance
    pushes = strength[:, None] * (x_i[i] - x_b[b])
    return x_b, np.stack([np.bincount(b, pushes[:, axis], len(x_b)) for axis in range(3)], axis=1)


def momentum_of(fluid: SPHFluid, mass: float) -> tuple[Curve, Curve]:
    """Linear [kg m/s] and angular momentum about the origin [kg m²/s] of particles of such a mass [kg]."""
    position, velocity = state_of(fluid)
    return mass * velocity.sum(axis=0), mass * np.cross(position, velocity).sum(axis=0)


def momentum_drifts(
    solver: Steppable,
    totals: Callable[[], tuple[Curve, Curve]],
    scales: tuple[float, float],
    duration: float,
    *,
    cuts: int,
) -> dict[str, list[float]]:
    """Change of the linear and the angular momentum over their scales, while a solver advances by a duration [s]."""
    linear, angular = totals()
    return recorded(
        solver,
        duration,
        cuts=cuts,
        linear=lambda: float(np.abs(totals()[0] - linear).max()) / scales[0],
        angular=lambda: float(np.abs(totals()[1] - angular).max()) / scales[1],
    )


def body(name: str, shape: dict[str, Any], **parameters: Any) -> RigidBodyParameters:
    """A dynamic body of 700 kg/m³, smooth and without restitution, unless `parameters` say otherwise."""
    defaults = {"kind": "dynamic", "density": 700.0, "friction": 0.0, "restitution": 0.0}
    if parameters.get("kind", "dynamic") != "dynamic":
        del defaults["density"]
    return RigidBodyParameters.model_validate({**defaults, "name": name, "shape": shape, **parameters})


def make_bodies(
    *bodies: RigidBodyParameters,
    gravity: tuple[float, float, float] = EARTH,
    domain: DomainParameters = HALL,
    obstacles: Sequence[RigidBodyParameters] = (),
    joints: Sequence[dict[str, Any]] = (),
) -> RigidSolver:
    """The solver of these bodies, with joints as a job file describes them."""
    from sim.rigid.joint_parameters import JointParameters
    from sim.rigid.solver import RigidSolver

    held = [JointParameters.model_validate(joint) for joint in joints]
    return RigidSolver(bodies, obstacles=obstacles, joints=held, domain=domain, gravity=gravity)


class Tank:
    """A fluid and bodies, coupled as a world couples them.

    Attributes:
        fluid: the fluid's solver.
        rigid: the bodies' solver.
        coupling: with the force on each body in the last step.
    """

    def __init__(
        self,
        solver: str,
        bodies: Sequence[RigidBodyParameters],
        *,
        domain: DomainParameters,
        depth: float = 0.0,
        gravity: tuple[float, float, float] = EARTH,
        block: tuple[Sequence[float], Sequence[float]] | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        **material: float,
    ) -> None:
        """Fill the tank around the bodies, up to a depth [m] or between two corners of a block [m]."""
        from sim.coupling.body_speed import expected_body_speed
        from sim.coupling.fluid_rigid import FluidRigidCoupling, samples_of_moving_bodies
        from sim.rigid.solver import RigidSolver
        from sim.shapes.placement import build_solid

        self.rigid = RigidSolver(bodies, domain=domain, gravity=gravity)
        low, high = block or (domain.min, (domain.max[0], domain.max[1], domain.min[2] + depth))
        points = lattice(low, high, SPACING)
        for each in bodies:
            # As a job fills its blocks: centres keep a radius from solids, up to float32 rounding.
            points = points[build_solid(each).signed_distance(points.astype(np.float64)) >= 0.4995 * SPACING]
        coupled = {
            "moving": samples_of_moving_bodies(self.rigid, SPACING),
            "body_count": len(bodies),
            "body_speed": expected_body_speed(bodies, self.rigid.solids, domain, gravity),
        }
        self.fluid = make_fluid(
            solver,
            domain,
            points,
            spacing=SPACING,
            velocities=np.broadcast_to(np.float32(velocity), points.shape),
            gravity=gravity,
            coupled=coupled,
            **material,
        )
        self.coupling = FluidRigidCoupling(self.fluid, self.rigid)

    def stable_dt(self) -> float:
        """Largest step [s] that fluid and bodies both take now."""
        return min(self.fluid.stable_dt(), self.rigid.stable_dt())

    def substep(self, dt: float) -> None:
        """One coupled substep of dt [s], in the order of `sim.core.world.World`."""
        self.fluid.substep(dt)
        self.coupling.exchange(dt)
        self.rigid.substep(dt)
        self.coupling.follow(dt)

    def first_bad_quantity(self) -> str | None:
        """What is not finite or runs away."""
        return self.fluid.first_bad_quantity() or self.rigid.first_bad_quantity()

    def astray(self) -> int:
        """Particles with their centre inside of a body by more than a tenth of a spacing, and those that left."""
        position, _ = state_of(self.fluid)
        inside = 0
        for number, turned in enumerate(self.rigid.bodies.rotation()):
            in_body = (position - self.rigid.bodies.position[number]) @ turned
            distance = self.rigid.solids[number].signed_distance(in_body)
            inside += int((distance < -0.1 * self.fluid.spacing).sum())
        return inside + self.fluid.tank.removed


def submerged_sphere(solver: str, density: float | None, radius: float, **material: float) -> Tank:
    """A sphere of a radius [m] and a density [kg/m³], without which it is held, in the middle of a cube of water."""
    side = SIDE_IN_RADII * radius
    kind = {"kind": "kinematic"} if density is None else {"density": density}
    sphere = body("sphere", {"type": "sphere", "radius": radius}, position=(0.0, 0.0, side / 2.0), **kind)
    domain = DomainParameters(min=(-side / 2.0, -side / 2.0, 0.0), max=(side / 2.0, side / 2.0, 1.4 * side))
    return Tank(solver, [sphere], domain=domain, depth=side, **material)
