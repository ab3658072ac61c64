"""Potentials and the flow, against the paper's formulas in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from whitewater_scenes import RADIUS, SPACING, fluid, lattice

from sim.whitewater.fluid_field import CREST_DIRECTION, FULL_NEIGHBORHOOD, SURFACE_ASYMMETRY, FluidField
from sim.whitewater.motion import FluidMotion, FluidState
from sim.whitewater.parameters import WhitewaterParameters

H = 4.0 * RADIUS
FULL_WEIGHT = FULL_NEIGHBORHOOD / 4.0
FULL_SURFACE_WEIGHT = np.pi * 4.0 / 3.0


def field_of(state: FluidState) -> FluidField:
    field = FluidField(FluidMotion(state, state, 1.0).bounds(), RADIUS, len(state.position))
    field.update(state)
    return field


def rough_ball() -> FluidState:
    """A ball of jittered particles, each with a velocity of its own."""
    random = np.random.default_rng(2)
    points = lattice((-0.12, -0.12, 0.3), (0.12, 0.12, 0.54))
    points = points[np.linalg.norm(points - [0, 0, 0.42], axis=1) < 0.1]
    points = points + random.uniform(-0.3, 0.3, points.shape) * SPACING
    return fluid(points, random.normal((1.0, 0.0, 0.5), 1.0, points.shape))


def reference(state: FluidState, min_speed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trapped air, wave crest and normals by the formulas, one particle at a time, in double precision."""
    x, v = state.position.astype(float), state.velocity.astype(float)
    near = [[j for j in row if j != i] for i, row in enumerate(cKDTree(x).query_ball_point(x, H))]
    normal = np.zeros_like(x)
    for i, row in enumerate(near):
        away = x[i] - x[row]
        r = np.linalg.norm(away, axis=1)
        mean = ((1 - r / H) / r) @ away / (1 - r / H).sum()
        if np.linalg.norm(mean) > SURFACE_ASYMMETRY:
            normal[i] = mean / np.linalg.norm(mean)
    trapped, crest = np.zeros(len(x)), np.zeros(len(x))
    for i, row in enumerate(near):
        if np.linalg.norm(v[i]) <= min_speed:
            continue
        x_ij, v_ij = x[i] - x[row], v[i] - v[row]
        r, speed = np.linalg.norm(x_ij, axis=1), np.linalg.norm(v_ij, axis=1)
        trapped[i] = (speed * (1 - (v_ij * x_ij).sum(axis=1) / (speed * r)) * (1 - r / H)).sum() / (2 * FULL_WEIGHT)
        if normal[i].any() and v[i] @ normal[i] >= CREST_DIRECTION * np.linalg.norm(v[i]):
            counted = (x_ij @ normal[i] > 0) & normal[row].any(axis=1)
            crest[i] = ((1 - normal[row] @ normal[i]) * (1 - r / H))[counted].sum() / FULL_SURFACE_WEIGHT
    return trapped, crest, normal


def test_potentials_are_those_of_the_formulas(taichi_cpu):
    state = rough_ball()
    trapped_air, wave_crest = field_of(state).potentials(1.0)
    trapped, crest, _ = reference(state, 1.0)
    assert (crest > 0).sum() > 20
    # Sums of some thirty terms of order 1 in single precision.
    np.testing.assert_allclose(trapped_air, trapped, atol=1e-5)
    np.testing.assert_allclose(wave_crest, crest, atol=1e-5)


@pytest.mark.parametrize(("approach", "trapped"), [(3.0, 3.0 * 0.5 / FULL_WEIGHT), (-3.0, 0.0)])
def test_two_particles_that_close_in_trap_their_speed_and_those_that_part_nothing(taichi_cpu, approach, trapped):
    velocities = approach * np.array([[1.0, 0, 0], [-2.0, 0, 0]]) / 3.0
    state = fluid(np.array([[0.0, 0.0, 0.5], [0.5 * H, 0.0, 0.5]]), velocities)
    trapped_air, _ = field_of(state).potentials(0.5)
    np.testing.assert_allclose(trapped_air, trapped, rtol=1e-5, atol=1e-6)


def test_a_flat_surface_is_no_crest_and_a_ridge_is_one(taichi_cpu):
    upwards = (0.0, 0.0, 2.0)
    pool = lattice((-0.2, -0.2, 0.2), (0.2, 0.2, 0.3))
    ridge = pool[np.abs(pool[:, 0]) < 0.3 - pool[:, 2] + SPACING]  # a roof along y, with its edge on top
    # Along a right-angled edge the outermost two slopes are seen, at 45° each, by a few of the disc's neighbours.
    for points, low, high in ((pool, 0.0, 1e-5), (ridge, WhitewaterParameters().min_wave_crest, 1.0)):
        _, wave_crest = field_of(fluid(points, upwards)).potentials(0.5)
        top = (points[:, 2] > 0.28) & (np.abs(points[:, 1]) < 0.1) & (np.abs(points[:, 0]) < 0.1)
        assert top.any()
        assert low <= wave_crest[top].max() <= high


def test_the_flow_between_particles_is_theirs_and_the_bulk_is_a_full_neighborhood(taichi_cpu):
    block = fluid(lattice((-0.2, -0.2, 0.2), (0.2, 0.2, 0.5)), (0.3, -0.2, 0.1))
    random = np.random.default_rng(3)
    points = random.uniform((-0.1, -0.1, 0.3), (0.1, 0.1, 0.4), (500, 3)).astype(np.float32)
    flow, neighbors = field_of(block).sample(points)
    np.testing.assert_allclose(flow, np.broadcast_to([0.3, -0.2, 0.1], flow.shape), atol=1e-6)
    # The mean over all places is the volume of the ball in cells; 500 places scatter by about 1.5 each.
    assert neighbors.mean() == pytest.approx(FULL_NEIGHBORHOOD, abs=0.3)


def test_far_from_the_fluid_there_is_no_flow(taichi_cpu):
    block = fluid(lattice((-0.1, -0.1, 0.2), (0.1, 0.1, 0.3)), (1.0, 0.0, 0.0))
    far = np.array([[0.0, 0.0, 0.9], [0.45, 0.45, 0.05], [30.0, -40.0, 50.0]], np.float32)
    flow, neighbors = field_of(block).sample(far)
    assert not flow.any()
    assert not neighbors.any()
