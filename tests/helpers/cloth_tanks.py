"""Builds small tanks of fluid with cloth in them."""

from collections.abc import Mapping

import numpy as np
from coupled_steps import CoupledSteps
from numpy.typing import NDArray

from sim.build import build_world
from sim.coupling.cloth_fluid import ClothFluidCoupling
from sim.scene import SceneParameters

SPACING = 0.02
EDGES = tuple({"edge": edge} for edge in ("x-", "x+", "y-", "y+"))
EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")


class ClothTank(CoupledSteps):
    """Water and one sheet, as a job describes them, and the world that steps both."""

    def __init__(
        self,
        *,
        cloth: Mapping[str, object],
        water: tuple[tuple[float, float, float], tuple[float, float, float]],
        domain: Mapping[str, object],
        solver: str = "wcsph",
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        water_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        force: tuple[Mapping[str, object], ...] = (),
        **fluid: object,
    ) -> None:
        low, high = np.array(water)
        block = {
            "shape": {"type": "box", "size": (high - low).tolist()},
            "position": (0.5 * (low + high)).tolist(),
            "velocity": water_velocity,
        }
        scene = {
            "gravity": gravity,
            "domain": domain,
            "force": force,
            "fluid": [{"name": "water", "solver": solver, "particle_radius": SPACING / 2, "block": [block], **fluid}],
            "cloth": [{"name": "sheet", "air_density": 0.0, "self_collision": False, **cloth}],
        }
        self.world = build_world(SceneParameters.model_validate(scene), frames_per_second=60.0)
        self.cloth = self.world.solvers["cloth"]
        coupling = next(each for each in self.world._couplings if isinstance(each, ClothFluidCoupling))
        super().__init__(self.world.solvers["water"], self.cloth, coupling)

    def particles(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Positions [m], velocities [m/s] and the mass of one [kg]."""
        arrays = self.fluid.snapshots()["water"].arrays
        mass = self.fluid.diagnostics()["mass"] / len(arrays["position"])
        return arrays["position"].astype(np.float64), arrays["velocity"].astype(np.float64), mass

    def nodes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Positions [m], velocities [m/s] and masses of the nodes [kg]."""
        state = self.cloth.state
        return state.positions(), state.velocity.to_numpy().astype(np.float64), state.mass.to_numpy().astype(np.float64)

    def momentum(self) -> NDArray[np.float64]:
        """Of water and sheet [N s]."""
        _, velocity, mass = self.particles()
        _, node_velocity, node_mass = self.nodes()
        return mass * velocity.sum(axis=0) + node_mass @ node_velocity

    def water_momentum(self) -> NDArray[np.float64]:
        """Of the water alone [N s]."""
        _, velocity, mass = self.particles()
        momentum: NDArray[np.float64] = mass * velocity.sum(axis=0)
        return momentum

    def energy(self) -> float:
        """Kinetic and potential energy of water and sheet, without that of springs [J]."""
        position, velocity, mass = self.particles()
        node_position, node_velocity, node_mass = self.nodes()
        down = np.array(self.fluid.gravity)
        kinetic = 0.5 * (mass * (velocity**2).sum() + node_mass @ (node_velocity**2).sum(axis=1))
        return float(kinetic - mass * (position @ down).sum() - node_mass @ (node_position @ down))


def rectangle(side: float, nodes: int) -> dict[str, object]:
    """Shape of a square sheet."""
    return {"type": "rectangle", "size": (side, side), "counts": (nodes, nodes)}
