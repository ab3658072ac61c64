"""Axis-aligned boxes: where things are, and whether they can meet, before their shapes are looked at."""

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.scene import SceneParameters
from sim.smoke.parameters import SmokeParameters

Box = NDArray[np.float64]
"""Lower and upper corner [m], (2, 3)."""

ALL = 1.0 - 1e-6
"""Share of a box that counts as all of it: sizes and positions written in decimal do not add up exactly."""


def domain_box(domain: DomainParameters) -> Box:
    """The box of a domain."""
    return np.array([domain.min, domain.max])


def smoke_box(smoke: SmokeParameters, domain: DomainParameters) -> Box:
    """The box of a smoke as the job gives it, empty or not."""
    return np.array([smoke.min or domain.min, smoke.max or domain.max])


def simulated_regions(scene: SceneParameters) -> list[Box]:
    """The boxes in which something happens: the domain, and each smoke's."""
    return [domain_box(scene.domain), *(smoke_box(smoke, scene.domain) for smoke in scene.smoke)]


def overlap(a: Box, b: Box) -> float:
    """Share of box `a` that lies in box `b` [-]."""
    sides = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
    return float(np.prod(np.clip(sides, 0.0, None)) / np.prod(a[1] - a[0]))


def touch(a: Box, b: Box, *, margin: float) -> bool:
    """Whether two boxes come closer than a margin [m]; far cheaper than signed distances of a mesh."""
    return bool(np.all((a[0] - margin <= b[1]) & (b[0] - margin <= a[1])))


def span(box: Box) -> str:
    """A box in words: `x -0.5..0.5 y -0.5..0.5 z 0..1 m`."""
    return " ".join(f"{axis} {low:.4g}..{high:.4g}" for axis, low, high in zip("xyz", *box, strict=True)) + " m"
