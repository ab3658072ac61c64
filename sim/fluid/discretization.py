"""Discretization of a fluid: spacing of its particles, support of the kernel, and all that follows from both."""

from dataclasses import dataclass
from functools import cached_property

from sim.fluid.kernels import SUPPORT_IN_SPACINGS, normalization, particle_volume


@dataclass(frozen=True)
class Discretization:
    """Particles of one volume on a lattice, and a kernel over them.

    Attributes:
        spacing: of the lattice, d [m].
        support_in_spacings: support radius h of the kernel over d [-].
    """

    spacing: float
    support_in_spacings: float = SUPPORT_IN_SPACINGS

    @cached_property
    def support_radius(self) -> float:
        """Support radius h [m]."""
        return self.support_in_spacings * self.spacing

    @cached_property
    def inverse_support(self) -> float:
        """1/h [1/m]."""
        return 1.0 / self.support_radius

    @cached_property
    def particle_volume(self) -> float:
        """Volume V of a particle [m³]."""
        return particle_volume(self.spacing, self.support_in_spacings)

    @cached_property
    def sigma(self) -> float:
        """Factor of the kernel, 8/(pi h³) [1/m³]."""
        return normalization(self.support_radius)

    @property
    def gradient_factor(self) -> float:
        """Factor of the kernel's gradient, sigma/h [1/m⁴]."""
        return self.sigma / self.support_radius
