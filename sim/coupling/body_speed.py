"""Largest speeds of bodies, cloths and soft matter, as far as their start and their paths tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.start import path_of_pin
from sim.core.domain import DomainParameters
from sim.core.host_access import copied
from sim.core.motion import rotation
from sim.core.parameters import Vector3
from sim.fluid.expected_speed import square_of_fall_speed
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes.body_geometry import BodyGeometry
from sim.soft.solver import SoftSolver


def expected_body_speed(
    parameters: Sequence[RigidBodyParameters],
    geometries: Sequence[BodyGeometry],
    domain: DomainParameters,
    gravity: Vector3,
) -> float:
    """Largest speed [m/s] to expect of any surface point of bodies that move; 0 without bodies.

    For a dynamic body that is the initial one with a fall of its centre of mass to the domain's deepest corner, and its
    initial spin; for a kinematic one the largest on its path, wherever that leads. What collisions of bodies add is
    not foreseen.
    """
    speeds = [0.0]
    for body, geometry in zip(parameters, geometries, strict=True):
        arm = geometry.centre_of_mass
        if body.kind == "kinematic":
            deforming = 0.0 if geometry.deformation is None else geometry.deformation.largest_speed
            speeds.append(path_of(body).largest_speed(float(np.linalg.norm(arm)) + geometry.radius) + deforming)
            continue
        centre = np.asarray(body.position) + rotation.rotated(rotation.from_degrees(body.rotation_deg), arm)
        fall = square_of_fall_speed(centre[None], domain, gravity)
        spin = math.hypot(*body.angular_velocity) * geometry.radius
        speeds.append(math.sqrt(math.hypot(*body.velocity) ** 2 + fall) + spin)
    return max(speeds)


def expected_cloth_speed(
    parameters: Sequence[ClothParameters], positions: NDArray[np.floating], domain: DomainParameters, gravity: Vector3
) -> float:
    """Largest speed [m/s] to expect of cloths, at these positions (n, 3) [m], or of their pins.

    That is the initial one with a fall to the domain's deepest corner.
    """
    fastest = max(math.hypot(*cloth.velocity) for cloth in parameters)
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    pins = [path_of_pin(pin).largest_speed(extent) for cloth in parameters for pin in cloth.pin if pin.keyframe]
    return max(math.sqrt(fastest**2 + square_of_fall_speed(positions, domain, gravity)), *pins, 0.0)


def expected_soft_speed(soft: SoftSolver, domain: DomainParameters) -> float:
    """Largest speed [m/s] to expect of soft matter: that of its start or its emitters, with a fall from the highest."""
    blocks = [math.hypot(*block.velocity) for body in soft.parameters for block in body.block]
    fastest = max([*blocks, soft.poured.largest_speed])
    places = copied(soft.particles.position)[copied(soft.particles.body) >= 0]
    points = np.concatenate([places, soft.poured.position])
    return math.sqrt(fastest**2 + square_of_fall_speed(points, domain, soft.gravity))
