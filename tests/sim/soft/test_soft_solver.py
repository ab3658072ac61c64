"""Bodies of soft matter by themselves: conservation, waves, falls, friction, bits, and what is stored."""

import math

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from thread_counts import digest_of, result_on_threads

from sim.core.domain import DomainParameters
from sim.soft import blocks
from sim.soft.parameters import SoftParameters
from sim.soft.solver import SoftSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

DOMAIN = DomainParameters(min=(-0.5, -0.5, -0.5), max=(0.5, 0.5, 0.5))
FREE = (0.0, 0.0, 0.0)
GRAVITY = 9.81


def soft(material="jelly", size=(0.2, 0.1, 0.1), **keys):
    block = {"shape": {"type": "box", "size": size}} | {
        key: keys.pop(key) for key in ("position", "velocity") if key in keys
    }
    return SoftParameters(name="it", material=material, block=(block,), **keys)


def advance(solver, time_s, watch=lambda _time_s: None):
    now = 0.0
    while now < time_s - 1e-12:
        dt = min(solver.stable_dt(), time_s - now)
        solver.substep(dt)
        now += dt
        watch(now)
        assert solver.first_bad_quantity() is None


def angular_momentum(solver):
    """Of positions and of the affine part that each particle carries, about the origin [kg m²/s]."""
    particles, h = solver.particles, solver.parameters[0].cell_size
    x, v = particles.position.to_numpy().astype(np.float64), particles.velocity.to_numpy().astype(np.float64)
    carried = 0.25 * h * h * particles.affine.to_numpy().astype(np.float64).reshape(3, 3, -1)
    lower, upper = carried[[2, 0, 1], [1, 2, 0]], carried[[1, 2, 0], [2, 0, 1]]
    return solver.mass / len(x) * (np.cross(x, v) + (lower - upper).T).sum(axis=0)


def momentum(solver):
    told = solver.diagnostics()
    return np.array([told[f"momentum_{axis}"] for axis in "xyz"])


def test_momentum_and_angular_momentum_are_kept_in_free_space():
    solver = SoftSolver([soft(velocity=(0.6, 0.2, 0.0))], domain=DOMAIN, gravity=FREE)
    place = solver.view("it")["position"]
    solver.push("it", np.cross([0.0, 3.0, 8.0], place).astype(np.float32))
    linear, angular = momentum(solver), angular_momentum(solver)
    advance(solver, 0.3)
    assert np.abs(solver.particles.strain.to_numpy()).max() > 0.01
    np.testing.assert_allclose(momentum(solver), linear, atol=1e-5 * np.linalg.norm(linear))
    np.testing.assert_allclose(angular_momentum(solver), angular, atol=1e-5 * np.linalg.norm(angular))


def test_a_free_bar_swings_along_itself_at_its_frequency_and_keeps_its_energy():
    length, cell = 0.4, 0.02
    body = soft(size=(length, 0.08, 0.08), young_modulus=1.0e5, poisson_ratio=0.0, cell_size=cell)
    solver = SoftSolver([body], domain=DOMAIN, gravity=FREE)
    mode = np.sin(math.pi * solver.view("it")["position"][:, 0] / length)
    solver.push("it", np.outer(0.05 * mode, (1.0, 0.0, 0.0)).astype(np.float32))
    expected = math.sqrt(1.0e5 / 1050.0) / (2.0 * length)
    times, shares = [], []

    def watch(now):
        times.append(now)
        shares.append(float(solver.view("it")["velocity"][:, 0] @ mode / (0.05 * mode @ mode)))

    advance(solver, 1.9 / expected, watch)
    share = np.array(shares)
    crossing = np.flatnonzero(share[:-1] * share[1:] < 0.0)
    moments = [times[k] + (times[k + 1] - times[k]) * share[k] / (share[k] - share[k + 1]) for k in crossing]
    assert 0.5 / np.diff(moments).mean() == pytest.approx(expected, rel=0.01)
    assert share[np.argmin(np.abs(np.array(times) - 1.0 / expected))] > 0.97


def test_a_bar_that_hits_a_wall_end_on_flies_back_as_fast_after_two_crossings_of_its_wave():
    length, speed, young, density = 0.4, 0.2, 1.0e5, 1050.0
    body = soft(
        size=(length, 0.08, 0.08),
        position=(-0.28, 0.0, 0.0),
        velocity=(-speed, 0.0, 0.0),
        young_modulus=young,
        poisson_ratio=0.0,
        friction=0.0,
    )
    solver = SoftSolver([body], domain=DOMAIN, gravity=FREE)
    wave = math.sqrt(young / density)
    gap, times, speeds = 0.02, [], []

    def watch(now):
        times.append(now)
        speeds.append(momentum(solver)[0] / solver.mass)

    advance(solver, gap / speed + 3.0 * length / wave, watch)
    times, speeds = np.array(times), np.array(speeds)
    # One-dimensional: the wall pushes with rho c v from the first touch until the wave is back.
    assert speeds[-1] == pytest.approx(speed, rel=0.05)
    push = np.interp([-0.5 * speed, 0.5 * speed], speeds, times)
    assert push[1] - push[0] == pytest.approx(length / wave, rel=0.05)


def test_it_falls_as_all_things_do():
    solver = SoftSolver([soft(position=(0.0, 0.0, 0.2))], domain=DOMAIN, gravity=(0.0, 0.0, -GRAVITY))
    before = solver.diagnostics()["centre_of_mass_z"]
    advance(solver, 0.2)
    fallen = before - solver.diagnostics()["centre_of_mass_z"]
    dt = solver.stable_dt()
    assert fallen == pytest.approx(0.5 * GRAVITY * 0.2**2, abs=0.5 * GRAVITY * 0.2 * dt)
    assert np.abs(solver.particles.strain.to_numpy()).max() < 1e-5


@pytest.mark.parametrize(("friction", "share"), [(0.3, 1.0), (0.8, 0.0)])
def test_a_block_slides_down_a_slope_as_coulomb_says(friction, share):
    angle = math.radians(30.0)
    gravity = (GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle))
    body = soft("rubber", size=(0.16, 0.16, 0.06), position=(-0.3, 0.0, -0.47), friction=friction, young_modulus=1.0e5)
    solver = SoftSolver([body], domain=DOMAIN, gravity=gravity)
    advance(solver, 0.25)
    speed = momentum(solver)[0] / solver.mass
    expected = 0.25 * GRAVITY * (math.sin(angle) - friction * math.cos(angle)) * share
    assert speed == pytest.approx(expected, abs=0.05)


def test_still_jelly_bears_its_weight():
    body = soft(size=(0.2, 0.2, 0.2), position=(0.0, 0.0, -0.4), young_modulus=2.0e4, friction=0.0)
    domain = DomainParameters(min=(-0.1, -0.1, -0.5), max=(0.1, 0.1, 0.5))
    solver = SoftSolver([body], domain=domain, gravity=(0.0, 0.0, -GRAVITY))
    rest = solver.diagnostics()["centre_of_mass_z"]
    heights = []
    advance(solver, 0.6, lambda _: heights.append(solver.diagnostics()["centre_of_mass_z"]))
    # Between walls it is strained in one direction: rho g (H - z) = (lambda + 2 mu) strain; the mean sinks by
    # rho g H²/3 of it.
    mu, lam = body.lame
    sag = 1050.0 * GRAVITY * 0.2**2 / (3.0 * (lam + 2.0 * mu))
    assert rest - np.mean(heights[len(heights) // 3 :]) == pytest.approx(sag, rel=0.1)


def test_blocks_are_stored_near_particles_alone():
    wide = DomainParameters(min=(-3.0, -3.0, -3.0), max=(3.0, 3.0, 3.0))
    solver = SoftSolver([soft(size=(0.1, 0.1, 0.1))], domain=wide, gravity=FREE)
    advance(solver, 0.01)
    # A cube of 5 cells, and the nodes that it reaches, in blocks of 4 nodes: 3 along an axis at most.
    assert 8.0 <= solver.diagnostics()["blocks"] <= 27.0


def test_what_passes_an_open_face_leaves_and_is_counted():
    domain = DomainParameters(min=(-0.2, -0.2, -0.2), max=(0.2, 0.2, 0.2), open_faces=("x+",))
    solver = SoftSolver([soft(velocity=(2.0, 0.0, 0.0))], domain=domain, gravity=FREE)
    count = solver.diagnostics()["particle_count"]
    advance(solver, 0.1)
    told = solver.diagnostics()
    assert 0.0 < told["particle_count"] < count
    assert told["particles_left"] == count - told["particle_count"]
    assert len(solver.snapshots()["it"].arrays["position"]) == told["particle_count"]


def test_bodies_of_another_grid_are_refused_together():
    pair = [soft(), soft(cell_size=0.05).model_copy(update={"name": "other"})]
    with pytest.raises(ValueError, match=r'soft "other": cell_size is 0.05, but 0.02 in soft\[0\] "it"'):
        SoftSolver(pair, domain=DOMAIN, gravity=FREE)


def run_two_materials(checkpoint, resume):
    """Digest of sand that falls onto snow, whole or from a checkpoint half way."""
    bodies = [
        soft("sand", size=(0.1, 0.1, 0.1), position=(0.0, 0.0, -0.3), young_modulus=1.0e5),
        soft("snow", size=(0.2, 0.2, 0.1), position=(0.0, 0.0, -0.45)).model_copy(update={"name": "snow"}),
    ]
    solver = SoftSolver(bodies, domain=DOMAIN, gravity=(0.0, 0.0, -5.0 * GRAVITY))
    if resume:
        with np.load(checkpoint) as arrays:
            solver.restore(dict(arrays))
    else:
        advance(solver, 0.03)
        np.savez(checkpoint, **solver.checkpoint())
    advance(solver, 0.03)
    return digest_of(solver.checkpoint())


@pytest.mark.slow
def test_bits_are_those_of_a_run_that_was_not_killed_whatever_the_threads(taichi_cpu, tmp_path):
    if taichi_cpu != "cpu":
        pytest.skip("compares numbers of threads")
    checkpoint = str(tmp_path / "checkpoint.npz")
    whole = result_on_threads(1, run_two_materials, checkpoint, False)
    assert result_on_threads(2, run_two_materials, checkpoint, True) == whole


def test_a_checkpoint_of_another_body_is_refused():
    solver = SoftSolver([soft()], domain=DOMAIN, gravity=FREE)
    other = SoftSolver([soft(size=(0.1, 0.1, 0.1))], domain=DOMAIN, gravity=FREE)
    with pytest.raises(ValueError, match="position of the checkpoint has shape"):
        solver.restore(other.checkpoint())


def test_what_is_not_a_number_is_told_and_stays_where_it_is():
    """Far from the corner of the domain that clamping would bring it to, and from all stored blocks there."""
    solver = SoftSolver([soft(position=(0.3, 0.3, 0.3), size=(0.1, 0.1, 0.1))], domain=DOMAIN, gravity=FREE)
    for _ in range(3):
        solver.substep(solver.stable_dt())
    stress = solver.particles.stress.to_numpy()
    stress[0] = np.nan
    solver.particles.stress.from_numpy(stress)
    for _ in range(10):
        solver.substep(solver.stable_dt())
    assert "not finite" in solver.first_bad_quantity()
    assert solver.view("it")["position"].min() > 0.2


def test_blocks_that_are_kept_while_particles_go_half_a_cell_give_the_bits_of_blocks_found_in_each_step(monkeypatch):
    found = []
    for margin in (blocks.MARGIN, 0.0):
        monkeypatch.setattr(blocks, "MARGIN", margin)
        solver = SoftSolver([soft(velocity=(1.0, 0.5, 0.0))], domain=DOMAIN, gravity=(0.0, 0.0, -GRAVITY))
        searches = 0
        find = solver._grid._find

        def counted(*arrays, find=find):
            nonlocal searches
            searches += 1
            return find(*arrays)

        monkeypatch.setattr(solver._grid, "_find", counted)
        for _ in range(40):
            solver.substep(solver.stable_dt())
        found.append((searches, solver.checkpoint()))
    (few, kept), (many, anew) = found
    assert 1 < few < 20 and many == 40
    for name, array in kept.items():
        np.testing.assert_array_equal(array, anew[name], err_msg=name)


def test_a_snowball_at_20_metres_a_second_is_crushed_to_the_density_of_firn_not_beyond_ice():
    """Crushing takes E theta/xi (exp(xi (1 - J)) - 1) a volume, 80 kJ/m³ at J = 0.46; cells at the front get more."""
    ball = {"shape": {"type": "sphere", "radius": 0.04}, "position": (0.0, 0.0, -0.45), "velocity": (0.0, 0.0, -20.0)}
    body = SoftParameters(name="it", material="snow", cell_size=0.01, block=(ball,))
    solver = SoftSolver([body], domain=DOMAIN, gravity=FREE)
    advance(solver, 0.012)
    density = 400.0 * np.exp(-solver.particles.history.to_numpy())
    assert 600.0 < np.median(density) < 800.0
    assert np.quantile(density, 0.95) < 917.0
    assert solver.view("it")["velocity"][:, 2].mean() > 0.0


def largest_part(solver):
    """Share of the particles in the largest part of them that gaps of more than a cell set apart."""
    position = solver.view("it")["position"]
    near = cKDTree(position).query_pairs(solver.parameters[0].cell_size, output_type="ndarray")
    n = len(position)
    _, part = connected_components(coo_matrix((np.ones(len(near)), near.T), (n, n)), directed=False)
    return np.bincount(part).max() / n


@pytest.mark.parametrize(("speed", "whole"), [(1.0, True), (12.0, False)])
def test_a_ball_of_packed_snow_bursts_where_it_hits_and_stays_whole_where_it_drops(speed, whole):
    """15 cm, onto a floor: from a height of 5 cm it keeps its cohesion, thrown it leaves no half together."""
    radius, cell = 0.075, 0.075 / 4.0
    ball = {"shape": {"type": "sphere", "radius": radius}, "position": (0, 0, radius - 0.5), "velocity": (0, 0, -speed)}
    body = SoftParameters(name="it", material="packed_snow", cell_size=cell, block=(ball,))
    solver = SoftSolver([body], domain=DOMAIN, gravity=(0.0, 0.0, -GRAVITY))
    advance(solver, 0.06)
    cohesive = (solver.particles.cohesion.to_numpy() > 0.5).mean()
    if whole:
        assert largest_part(solver) == 1.0
        assert cohesive > 0.8
    else:
        assert largest_part(solver) < 0.5
        assert cohesive < 0.5
