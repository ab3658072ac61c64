"""Which bodies can come into a smoke's box, and which of them its cells are too coarse for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.core.parameters import Vector3
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes.body_geometry import BodyGeometry
from sim.smoke.parameters import SmokeParameters, boxes_overlap


def too_thin_bodies(
    smoke: SmokeParameters,
    bodies: Sequence[RigidBodyParameters],
    geometries: Sequence[BodyGeometry],
    domain: DomainParameters,
) -> list[tuple[int, str]]:
    """Number and a sentence for each of the moving bodies that would fall between the cells of a smoke it can come to.

    The domain holds the dynamic ones, and is the box of a smoke without its own.
    """
    return [
        (
            number,
            f'is {geometry.shortest_edge:.3g} m thin and would fall between the cells of smoke "{smoke.name}", '
            f"{smoke.cell_size:g} m, into whose box it can come; use a smaller cell_size or a thicker body",
        )
        for number, (body, geometry) in enumerate(zip(bodies, geometries, strict=True))
        if geometry.shortest_edge < smoke.cell_size and can_come(body, geometry, smoke, domain)
    ]


def can_come(
    body: RigidBodyParameters, geometry: BodyGeometry, smoke: SmokeParameters, domain: DomainParameters
) -> bool:
    """Whether a body may come to where a smoke can be: by its path, or if it may leave the domain."""
    box = smoke.limits(domain)
    reach = float(np.linalg.norm(geometry.centre_of_mass)) + geometry.radius
    if body.kind == "kinematic":
        low, high = path_of(body).hull()
        return boxes_overlap(_corners(low - reach, high + reach), box)
    place = np.asarray(body.position)
    return (
        bool(domain.open_faces)
        or boxes_overlap((domain.min, domain.max), box)
        or boxes_overlap(_corners(place - reach, place + reach), box)
    )


def _corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[Vector3, Vector3]:
    (a, b, c), (d, e, f) = low.tolist(), high.tolist()
    return (a, b, c), (d, e, f)
