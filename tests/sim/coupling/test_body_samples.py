"""The samples that stand for a body's volume."""

import numpy as np
import pytest
from coupled_tanks import SPACING

from sim.coupling.body_samples import completing_factor
from sim.fluid.boundary_akinci2012 import BoundarySamples, sink_samples
from sim.rigid.geometry import BodyGeometry
from sim.rigid.parameters import RigidBodyParameters


def factor_of(shape: dict) -> float:
    body = BodyGeometry(
        RigidBodyParameters.model_validate({"name": "body", "kind": "dynamic", "density": 1.0, "shape": shape})
    )
    surface = body.samples(SPACING)
    sunk = sink_samples(surface, body.signed_distance, SPACING)
    return completing_factor(sunk, surface, body.signed_distance, SPACING)


def test_the_more_a_body_curves_the_more_its_samples_have_to_stand_for():
    factors = [factor_of({"type": "sphere", "radius": radius * SPACING}) for radius in (3, 4, 6, 12)]
    assert (np.diff(factors) < 0.0).all()
    # Samples of a sphere of three spacings lie on a sphere of two.
    assert factors[0] == pytest.approx(1.24, abs=0.04)
    # Flat: 1 but for the scatter of the samples, which costs a few percent.
    assert factors[-1] == pytest.approx(1.0, abs=0.03)


def test_flat_bodies_are_complete_and_thin_ones_are_not_weakened():
    assert factor_of({"type": "box", "size": (12 * SPACING,) * 3}) == pytest.approx(1.0, abs=0.05)
    assert factor_of({"type": "box", "size": (12 * SPACING, 12 * SPACING, 0.6 * SPACING)}) == 1.0


def test_a_factor_multiplies_the_volumes():
    points = np.random.default_rng(3).normal(0.0, 0.05, (50, 3))
    bare = BoundarySamples.of_bodies(points)
    factor = np.linspace(0.5, 2.0, 50)
    scaled = BoundarySamples(bare.positions, bare.body, factor)
    np.testing.assert_array_equal(scaled.volumes(SPACING), factor * bare.volumes(SPACING))
