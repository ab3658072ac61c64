import numpy as np
import pytest

from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples, sink_samples
from sim.fluid.kernels import wall_calibration
from sim.scene import DomainParameters

SPACING = 0.02
DEPTH = (wall_calibration().standoff_in_spacings - 0.5) * SPACING


def test_walls_lie_outside_of_closed_faces_only():
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.2, 0.1, 0.3), open_faces=("z+",))
    samples = domain_wall_samples(domain, SPACING)
    assert samples.min(axis=0) == pytest.approx([-DEPTH, -DEPTH, -DEPTH])
    inside = ((samples > 0.0) & (samples < (0.2, 0.1, 0.3))).all(axis=1)
    assert not inside.any()
    over_the_opening = (
        (samples[:, 2] > 0.3) & (samples[:, :2] > 0.0).all(axis=1) & (samples[:, :2] < (0.2, 0.1)).all(axis=1)
    )
    assert not over_the_opening.any()


def test_walls_that_meet_share_their_edge_samples():
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.2, 0.2, 0.2), open_faces=())
    samples = domain_wall_samples(domain, SPACING)
    assert len(np.unique(samples, axis=0)) == len(samples)


def test_a_domain_without_walls_has_no_samples():
    domain = DomainParameters(open_faces=("x-", "x+", "y-", "y+", "z-", "z+"))
    assert domain_wall_samples(domain, SPACING).shape == (0, 3)


def test_sample_volumes_even_out_uneven_sampling():
    axis = np.arange(-8, 9) * SPACING
    plane = np.stack(np.meshgrid(axis, axis, [0.0], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    doubled = np.concatenate([plane, plane + np.float32([SPACING / 2, 0.0, 0.0])])
    once = BoundarySamples.of_bodies(plane).volumes(SPACING)
    twice = BoundarySamples.of_bodies(doubled).volumes(SPACING)
    centre = np.linalg.norm(plane, axis=1) < 3 * SPACING
    centre_doubled = np.linalg.norm(doubled, axis=1) < 3 * SPACING
    # Per area: twice the samples with half of the volume each. The kernel resolves one spacing to about 5 %.
    assert 2.0 * twice[centre_doubled].mean() == pytest.approx(once[centre].mean(), rel=0.05)


def test_volume_of_a_sample_counts_its_own_body_only():
    plane = domain_wall_samples(
        DomainParameters(max=(0.5, 0.5, 1.0), open_faces=("x-", "x+", "y-", "y+", "z+")), SPACING
    )
    alone = BoundarySamples.of_bodies(plane).volumes(SPACING)
    beside = BoundarySamples.of_bodies(plane, plane + np.float32([0, 0, SPACING / 4])).volumes(SPACING)
    np.testing.assert_array_equal(beside[: len(plane)], alone)


def test_boundary_samples_refuse_wrong_shapes_and_nan():
    with pytest.raises(ValueError, match=r"must be \(m, 3\)"):
        BoundarySamples(np.zeros((4, 2), np.float32), np.zeros(4, np.int32))
    with pytest.raises(ValueError, match="finite"):
        BoundarySamples.of_bodies(np.array([[0.0, np.nan, 0.0]]))


def test_samples_of_a_sphere_sink_to_where_fluid_touches_the_surface():
    directions = np.random.default_rng(0).normal(size=(300, 3))
    sphere = 0.1 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    sunk = sink_samples(sphere, lambda points: np.linalg.norm(points, axis=1) - 0.1, SPACING)
    # Six rounds leave 0.4^6 = 0.4 % of the depth.
    np.testing.assert_allclose(np.linalg.norm(sunk, axis=1), 0.1 - DEPTH, atol=0.005 * DEPTH)


def test_samples_of_a_thin_plate_stay_inside():
    half_thickness = 0.3 * DEPTH
    plate = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (-half_thickness, half_thickness)])
    sunk = sink_samples(plate, lambda points: np.abs(points[:, 2]) - half_thickness, SPACING)
    assert (np.abs(sunk[:, 2]) <= half_thickness).all()
