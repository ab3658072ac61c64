"""Particles that fill solids and samples that cover surfaces."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.sampling import fill_with_particles, sample_surface
from sim.shapes.solid import ShapeError

BALL = build_solid(Placement(shape={"type": "sphere", "radius": 0.25}))


def box(size, position=(0.0, 0.0, 0.0)):
    return build_solid(Placement(shape={"type": "box", "size": size}, position=position))


@pytest.mark.parametrize("spacing", [0.02, 0.03, 0.1])
def test_box_of_k_spacings_gets_k_cubed_particles(spacing):
    particles = fill_with_particles(box((7 * spacing,) * 3, position=(0.11, -0.07, 0.3)), spacing)
    assert len(particles) == 7**3
    assert particles.dtype == np.float32


def test_particles_stand_half_a_spacing_inside():
    particles = fill_with_particles(box((0.3, 0.2, 0.1), position=(0.5, 0.5, 0.05)), 0.02)
    assert len(particles) == 15 * 10 * 5
    # float32 at 0.65 m: 6e-8 m
    np.testing.assert_allclose(particles.min(axis=0), [0.36, 0.41, 0.01], atol=1e-7)
    np.testing.assert_allclose(particles.max(axis=0), [0.64, 0.59, 0.09], atol=1e-7)


def test_filled_ball_keeps_half_a_spacing_of_margin_and_most_of_its_volume():
    spacing = 0.02
    particles = fill_with_particles(BALL, spacing)
    assert np.linalg.norm(particles, axis=1).max() <= 0.25 - 0.5 * spacing + 1e-6
    # Lattice points in a ball of radius 0.24, each standing for a cube: its volume within the surface term.
    assert len(particles) * spacing**3 == pytest.approx(4.0 / 3.0 * np.pi * 0.24**3, rel=0.02)


def test_bounds_cut_the_lattice_and_keep_half_a_spacing_from_them():
    solid = box((0.4, 0.4, 0.4))
    particles = fill_with_particles(solid, 0.02, lower=(-1.0, -1.0, 0.0), upper=(0.1, 1.0, 1.0))
    assert len(particles) == 15 * 20 * 10
    np.testing.assert_allclose(particles.min(axis=0), [-0.19, -0.19, 0.01], atol=1e-7)
    assert particles[:, 0].max() == pytest.approx(0.09, abs=1e-7)


def test_bounds_beside_the_solid_leave_nothing():
    assert fill_with_particles(BALL, 0.02, lower=(1.0, 1.0, 1.0)).shape == (0, 3)


def test_absurdly_fine_filling_is_refused_before_it_takes_the_memory():
    with pytest.raises(ShapeError, match=r"0.5 x 0.5 x 0.5 m at a spacing of 1e-05 m takes .* use a larger spacing"):
        fill_with_particles(BALL, 1.0e-5)


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "box", "size": (0.3, 0.2, 0.1)},
        {"type": "sphere", "radius": 0.25},
        {"type": "torus", "major_radius": 0.2, "minor_radius": 0.05},
        {"type": "cone", "radius": 0.1, "height": 0.2},
    ],
    ids=lambda shape: shape["type"],
)
def test_surface_samples_are_spread_evenly_on_the_surface(shape):
    spacing = 0.02
    solid = build_solid(Placement(shape=shape, rotation_deg=(20.0, 30.0, 0.0), position=(0.2, 0.1, 0.0)))
    mesh = solid.surface_mesh()
    samples = sample_surface(mesh, spacing)
    assert samples.dtype == np.float32
    # On the triangles, whose chords cut up to 9e-5 m below the round surfaces: half a percent of the spacing.
    assert np.abs(solid.signed_distance(samples)).max() < 1e-4

    tree = cKDTree(samples)
    nearest = tree.query(samples, k=2)[0][:, 1]
    assert nearest.min() >= 0.8 * spacing - 1e-7  # float32
    everywhere, _ = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), 100_000, seed=1)
    assert tree.query(everywhere)[0].max() < 1.05 * spacing
    area = np.linalg.norm(mesh.area_vectors, axis=1).sum()
    # Measured 0.90 to 0.95 over all primitives; edges and curvature move it by some percent.
    assert len(samples) * spacing**2 / area == pytest.approx(0.93, abs=0.06)


def test_samples_are_the_same_every_time():
    mesh = BALL.surface_mesh()
    np.testing.assert_array_equal(sample_surface(mesh, 0.03), sample_surface(mesh, 0.03))


def test_body_smaller_than_the_spacing_still_gets_a_sample():
    tiny = build_solid(Placement(shape={"type": "sphere", "radius": 0.001}))
    assert len(sample_surface(tiny.surface_mesh(), 0.02)) == 1


def test_absurdly_fine_sampling_is_refused():
    with pytest.raises(ShapeError, match=r"takes 7.9e\+09 samples; use a larger spacing"):
        sample_surface(BALL.surface_mesh(), 1.0e-5)
