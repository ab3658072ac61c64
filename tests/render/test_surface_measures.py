"""What is measured of a surface's look tells bumps of the particles' size from waves of the water."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.surface_measures import bumps_deg
from render.meshes import SurfaceMesh

RADIUS = 0.005


def pool() -> np.ndarray:
    """Particles at rest below z = 0."""
    axes = [np.arange(24), np.arange(24), -0.5 - np.arange(5)]
    return (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * 2 * RADIUS).astype(np.float32)


def rippled(wavelength: float, slope: float) -> SurfaceMesh:
    """The pool's surface, its normals tilted along x by a wave of that length [m] and steepest slope."""
    axis = np.arange(4 * RADIUS, 42 * RADIUS, RADIUS / 2)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    normals = np.stack([slope * np.cos(2 * np.pi * x / wavelength), 0 * x, np.ones_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.stack([x, y, 0 * x], axis=1)
    return SurfaceMesh(vertices.astype(np.float32), np.empty((0, 3), np.int32), normals.astype(np.float32))


def test_bumps_of_the_particles_size_are_told_by_their_slope():
    slope = np.tan(np.radians(5.0))
    # The median of |cos| over a wave is cos(45°), and the mean over four spacings of two periods is upright.
    expected = 5.0 * np.cos(np.radians(45.0))
    assert bumps_deg(rippled(4 * RADIUS, slope), pool(), RADIUS) == pytest.approx(expected, rel=0.15)


def test_long_waves_are_no_bumps():
    slope = np.tan(np.radians(5.0))
    # A disc of four radii sees a fifth of the wave: its mean differs from its middle by the curvature alone.
    assert bumps_deg(rippled(40 * RADIUS, slope), pool(), RADIUS) < 0.1 * 5.0


def test_droplets_have_no_bumps():
    assert bumps_deg(rippled(4 * RADIUS, 0.1), np.zeros((1, 3), np.float32), RADIUS) is None
