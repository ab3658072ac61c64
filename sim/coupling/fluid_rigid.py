"""Two-way coupling of a particle fluid and the rigid bodies that move in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.core.solver import Coupling
from sim.fluid.boundary import BodyStates

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.rigid.solver import RigidSolver


class FluidRigidCoupling(Coupling):
    """The fluid pushes the bodies, and the bodies displace and push the fluid.

    A coupled step: the fluid steps with the bodies where they are and sums its impulses on them; the bodies take the
    impulses, then gravity and contacts, and move; the fluid's samples of the bodies follow. Impulses are opposite pair
    by pair and bodies get exactly what the fluid lost, so that linear and angular momentum are kept to rounding.
    Kinematic bodies push the fluid and feel nothing.

    Attributes:
        force: mean force of the fluid on each body in the last step [N], (n, 3); kinematic bodies have one too.
    """

    def __init__(self, fluid: SPHFluid, rigid: RigidSolver) -> None:
        """Couple the two; places the fluid's samples where the bodies are."""
        self.bodies = (fluid.name, rigid.name)
        self._fluid, self._rigid = fluid, rigid
        self.force: NDArray[np.float64] = np.zeros((len(rigid.bodies), 3))
        self.follow(0.0)

    def exchange(self, dt: float) -> None:
        """Hand the fluid's impulses of its substep of dt [s] to the bodies."""
        linear, angular = self._fluid.body_forces.take_impulses()
        self._rigid.bodies.apply_impulses(linear, angular)
        self.force = linear / dt

    def follow(self, dt: float) -> None:
        """Put the fluid's samples where the bodies are after a substep of dt [s]; 0 before the first."""
        bodies = self._rigid.bodies
        states = BodyStates(bodies.position, bodies.rotation(), bodies.velocity, bodies.angular_velocity)
        self._fluid.tank.move_bodies(states, elapsed_s=dt)
        self.resume()

    def resume(self) -> None:
        """Hand the inverse masses of the bodies to the fluid, which saves where they are."""
        bodies, response = self._rigid.bodies, self._fluid.body_forces.response
        if response is not None:
            response.set_mobility(bodies.inverse_mass, bodies.inverse_inertia())
