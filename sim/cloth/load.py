"""What a coupling lays onto the nodes for a substep: mass that moves along with them, and impulses."""

import taichi as ti

from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Vectors
from sim.core.launch import kernel
from sim.core.parameters import Vector3


class NodeLoad:
    """Mass that moves along with the nodes in a substep without weighing on them, and impulses.

    Attributes:
        mass: of each node's load [kg], (n,).
        impulse: on each node together with its load [N s], (n,) vec3.
    """

    def __init__(self, count: int) -> None:
        self.mass, self._own_inverse = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        self.impulse = ti.Vector.ndarray(3, ti.f32, count)

    def put_on(self, state: ClothState, gravity: Vector3, dt: float) -> None:
        """Let the nodes take their impulses and carry their loads; gravity [m/s²] is what they will feel in dt [s]."""
        put_on_load(
            self.mass, self.impulse, ti.math.vec3(*gravity), dt, state.inverse_mass, self._own_inverse, state.velocity
        )

    def take_off(self, state: ClothState) -> None:
        """Give the nodes their own masses back."""
        take_off_load(self._own_inverse, state.inverse_mass)


@kernel
def put_on_load(
    mass: Floats,
    impulse: Vectors,
    gravity: ti.math.vec3,
    dt: ti.f32,
    inverse_mass: Floats,
    own_inverse: Floats,
    velocity: Vectors,
):
    """v_n += J_n/(m_n + m_load), less what gravity would do to the load, with the mass of both from then on."""
    for n in range(inverse_mass.shape[0]):
        w_n = inverse_mass[n]
        own_inverse[n] = w_n
        if w_n > 0.0:
            with_load = w_n / (1.0 + mass[n] * w_n)
            velocity[n] += with_load * (impulse[n] - dt * mass[n] * gravity)
            inverse_mass[n] = with_load


@kernel
def take_off_load(own_inverse: Floats, inverse_mass: Floats):
    """The masses that nodes had before."""
    for n in range(inverse_mass.shape[0]):
        inverse_mass[n] = own_inverse[n]
