"""The samples that stand for a body's volume."""

import numpy as np
import pytest
from coupled_tanks import SPACING, Tank

from sim.core.domain import DomainParameters
from sim.coupling.completion import LEAST_FACTOR, completing_factors, least_factor
from sim.fluid.boundary_akinci2012 import BoundarySamples, sink_samples
from sim.fluid.kernels import evaluate
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.body_geometry import BodyGeometry


def geometry(shape: dict) -> BodyGeometry:
    return BodyGeometry(
        RigidBodyParameters.model_validate({"name": "body", "kind": "dynamic", "density": 1.0, "shape": shape})
    )


def samples_of(shape: dict) -> tuple[np.ndarray, np.ndarray]:
    """Samples in the body [m], (m, 3), and their factors, (m,)."""
    body = geometry(shape)
    surface = body.samples(SPACING)
    sunk = sink_samples(surface, body.signed_distance, SPACING)
    return sunk.positions, completing_factors(sunk, surface, body.signed_distance, SPACING)


def test_the_more_a_body_curves_the_more_its_samples_have_to_stand_for():
    means = [samples_of({"type": "sphere", "radius": radius * SPACING})[1].mean() for radius in (3, 4, 6, 12)]
    assert (np.diff(means) < 0.0).all()
    # Samples of a sphere of three spacings lie on a sphere of two.
    assert means[0] == pytest.approx(1.22, abs=0.05)
    # Flat: 1 but for the scatter of the samples, which costs a few percent.
    assert means[-1] == pytest.approx(1.0, abs=0.05)


def test_flat_bodies_are_complete_and_those_thinner_than_two_layers_of_samples_share_the_push():
    side = 12 * SPACING
    assert samples_of({"type": "box", "size": (side, side, side)})[1].mean() == pytest.approx(1.0, abs=0.05)
    _, sheet = samples_of({"type": "box", "size": (side, side, 0.6 * SPACING)})
    np.testing.assert_array_equal(sheet, LEAST_FACTOR)


def test_a_body_with_a_thin_part_is_weaker_there_only():
    # The tip of a cone is thinner than its samples should be deep; the middle of its base is flat.
    height = 12 * SPACING
    positions, factors = samples_of({"type": "cone", "radius": 8 * SPACING, "height": height})
    along = positions[:, 2] - positions[:, 2].min()
    assert factors[along > 0.8 * height].mean() < 0.7
    is_amid_base = (along < 0.3 * height) & (np.hypot(positions[:, 0], positions[:, 1]) < 4 * SPACING)
    # The scatter of some forty samples.
    assert factors[is_amid_base].mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("radius", [0.002, 0.003])
def test_samples_of_a_body_much_smaller_than_a_spacing_have_the_least_factor(radius):
    _, factors = samples_of({"type": "sphere", "radius": radius})
    np.testing.assert_array_equal(factors, LEAST_FACTOR)


def test_a_surface_without_samples_has_no_factors():
    body = geometry({"type": "sphere", "radius": 4 * SPACING})
    nothing = np.empty((0, 3))
    sunk = sink_samples(nothing, body.signed_distance, SPACING)
    assert completing_factors(sunk, nothing, body.signed_distance, SPACING).shape == (0,)


@pytest.mark.parametrize("support", [2.5, 3.0, 4.0])
@pytest.mark.parametrize("thickness", [0.5, 1.0, 2.0, 3.0])
def test_a_moving_plate_lets_nothing_through_at_any_support(support, thickness):
    body = geometry({"type": "box", "size": (14 * SPACING, 14 * SPACING, thickness * SPACING)})
    surface = body.samples(SPACING)
    sunk = sink_samples(surface, body.signed_distance, SPACING, support)
    samples = sunk.scaled(completing_factors(sunk, surface, body.signed_distance, SPACING, support))
    amid = np.concatenate([np.random.default_rng(0).uniform(-2.0, 2.0, (50, 2)), np.zeros((50, 1))], axis=1) * SPACING
    distances = np.linalg.norm(amid[:, None] - samples.positions, axis=2)
    density = evaluate(distances, support * SPACING) @ samples.volumes(SPACING, support)
    # 1.5 on a sample; the scatter of the samples costs a tenth between them, and a few percent in the mean.
    assert density.mean() > 1.4
    assert density.min() > 1.25


@pytest.mark.parametrize("support", [2.5, 4.0])
def test_water_stays_above_a_thin_plate_across_the_tank(taichi_cpu, support):
    size, middle, thickness = 8 * SPACING, 6 * SPACING, SPACING
    surface = middle + 0.5 * thickness
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(size, size, 18 * SPACING))
    plate = {"type": "box", "size": (14 * SPACING, 14 * SPACING, thickness)}
    tank = Tank(
        [{"kind": "kinematic", "shape": plate, "position": (0.5 * size, 0.5 * size, middle)}],
        domain=domain,
        water=((0.0, 0.0, surface), (size, size, surface + size)),
        solver="dfsph",
        support_in_spacings=support,
    )
    tank.run(0.15)
    # Through samples that only complete the density at the surface half of the water falls in this time.
    assert tank.fluid.snapshots()["water"].arrays["position"][:, 2].min() > surface


def test_the_least_factor_of_the_usual_support_is_the_constant_to_the_bit():
    assert least_factor() == LEAST_FACTOR


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["wcsph", "dfsph"])
def test_a_thin_plate_displaces_its_volume(taichi_cpu, solver):
    size = (8 * SPACING, 8 * SPACING, 1.5 * SPACING)
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(16 * SPACING, 16 * SPACING, 16 * SPACING))
    tank = Tank(
        [{"kind": "kinematic", "shape": {"type": "box", "size": size}, "position": (*(8 * SPACING,) * 2, 6 * SPACING)}],
        domain=domain,
        water=(domain.min, (16 * SPACING, 16 * SPACING, 12 * SPACING)),
        solver=solver,
    )
    tank.run(0.4)
    impulse, time = 0.0, 0.0
    while time < 0.4:
        dt = tank.step()
        impulse, time = impulse + dt * tank.coupling.force[0, 2], time + dt
    # A twentieth of a spacing off each face is 7 % of so thin a plate, and the mean of a force that sways by a tenth of
    # it errs by some percent. With samples all as strong as a wall's it is 1.4 times as much.
    assert impulse / time == pytest.approx(9810.0 * np.prod(size), rel=0.12)


def test_a_factor_multiplies_the_volumes():
    points = np.random.default_rng(3).normal(0.0, 0.05, (50, 3))
    bare = BoundarySamples.of_bodies(points)
    factor = np.linspace(0.5, 2.0, 50)
    np.testing.assert_allclose(bare.scaled(factor).volumes(SPACING), factor * bare.volumes(SPACING), rtol=1.0e-12)
