"""Laws of soft matter, against formulas, for single strains."""

import math

import numpy as np
import pytest
import taichi as ti

from sim.core.arrays import Floats, Matrices, Vectors
from sim.core.launch import kernel
from sim.soft.laws import Laws, expm1, log1p, moved_strain, principal, recomposed, respond
from sim.soft.parameters import SoftParameters
from sim.soft.solver import laws_of

pytestmark = pytest.mark.usefixtures("taichi_cpu")

BLOCK = ({"shape": {"type": "sphere", "radius": 0.1}},)


@kernel
def answer(
    trial: Matrices,
    history: Floats,
    cohesion: Floats,
    dt: ti.f32,
    laws: Laws,
    strain: Matrices,
    stress: Matrices,
    told: Floats,
):
    for k in range(trial.shape[0]):
        e, tau, after, left = respond(trial[k], 0, history[k], cohesion[k], dt, laws)
        strain[k], stress[k], told[k], cohesion[k] = e, tau, after, left


@kernel
def decompose(given: Matrices, values: Vectors, axes: Matrices, again: Matrices):
    for k in range(given.shape[0]):
        own, columns = principal(given[k])
        values[k], axes[k], again[k] = own, columns, recomposed(columns, own)


@kernel
def logarithms(x: Floats, logs: Floats, powers: Floats):
    for k in range(x.shape[0]):
        logs[k], powers[k] = log1p(x[k]), expm1(x[k])


@kernel
def move(given: Matrices, change: Matrices, after: Matrices):
    for k in range(given.shape[0]):
        after[k] = moved_strain(given[k], change[k])


def matrices(values):
    array = ti.Matrix.ndarray(3, 3, ti.f32, len(values))
    array.from_numpy(np.ascontiguousarray(values, np.float32))
    return array


def floats(values):
    array = ti.ndarray(ti.f32, len(values))
    array.from_numpy(np.ascontiguousarray(values, np.float32))
    return array


def answered(body, trials, history=0.0, dt=1.0e-4, cohesion=None):
    """Elastic strain e, Kirchhoff stress and history of trial strains, in float64; `cohesion` becomes what is left."""
    n = len(trials)
    before, left = floats(np.full(n, history)), floats(np.ones(n) if cohesion is None else cohesion)
    out = matrices(np.zeros((n, 3, 3))), matrices(np.zeros((n, 3, 3))), floats(np.zeros(n))
    answer(matrices(trials), before, left, dt, laws_of([body]), *out)
    if cohesion is not None:
        cohesion[:] = left.to_numpy()
    return tuple(each.to_numpy().astype(np.float64) for each in out)


def soft(material, **keys):
    return SoftParameters(name="it", material=material, block=BLOCK, **keys)


def strains_of(hencky, turn):
    """b - 1 of principal Hencky strains in axes turned at random."""
    return turn @ np.diag(np.expm1(2.0 * np.asarray(hencky))) @ turn.T


def random_turns(n, seed=3):
    rng = np.random.default_rng(seed)
    return np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]


def test_principal_values_and_axes_are_those_of_the_matrix():
    rng = np.random.default_rng(1)
    given = rng.normal(size=(200, 3, 3)) * 10.0 ** rng.uniform(-6, 1, (200, 1, 1))
    given += given.transpose(0, 2, 1)
    given[:3] = 0.0
    given[1] = np.diag([2.0, 2.0, -1.0])
    values = ti.Vector.ndarray(3, ti.f32, 200)
    axes, again = matrices(np.zeros((200, 3, 3))), matrices(np.zeros((200, 3, 3)))
    decompose(matrices(given), values, axes, again)
    size = np.linalg.norm(given, axis=(1, 2))
    expected = np.linalg.eigvalsh(given)
    np.testing.assert_array_less(np.abs(np.sort(values.to_numpy(), axis=1) - expected).max(axis=1), 1e-6 * size + 1e-30)
    assert np.abs(again.to_numpy() - given).max(axis=(1, 2)) == pytest.approx(0.0, abs=3e-6 * size.max())
    turned = axes.to_numpy()
    np.testing.assert_allclose(turned.transpose(0, 2, 1) @ turned, np.tile(np.eye(3), (200, 1, 1)), atol=2e-6)


def test_logarithms_keep_their_digits_near_0_and_join_where_the_series_ends():
    x = np.array([1e-7, -1e-5, 1e-3, -0.2999, 0.2999, 0.3001, -0.3001, 2.0])
    logs, powers = floats(x), floats(x)
    logarithms(floats(x), logs, powers)
    np.testing.assert_allclose(logs.to_numpy(), np.log1p(np.float32(x)), rtol=2e-6)
    np.testing.assert_allclose(powers.to_numpy(), np.expm1(np.float32(x)), rtol=2e-6)


def test_strains_move_with_the_deformation():
    rng = np.random.default_rng(2)
    before, change = 0.1 * rng.normal(size=(50, 3, 3)), 0.05 * rng.normal(size=(50, 3, 3))
    before += before.transpose(0, 2, 1)
    after = matrices(np.zeros((50, 3, 3)))
    move(matrices(before), matrices(change), after)
    gradient = np.eye(3) + change
    expected = gradient @ (np.eye(3) + before) @ gradient.transpose(0, 2, 1) - np.eye(3)
    np.testing.assert_allclose(after.to_numpy(), expected, atol=2e-6)


@pytest.mark.parametrize("material", ["jelly", "rubber", "sand", "snow", "clay"])
def test_small_strains_have_the_stresses_of_hooke(material):
    body = soft(material, **({"friction_angle_deg": 60.0} if material == "sand" else {}))
    mu, lam = body.lame
    hencky = np.array([-2.0e-4, -1.8e-4, -1.9e-4])
    for turn in random_turns(3):
        _, (stress,), _ = answered(body, [strains_of(hencky, turn)])
        expected = turn @ np.diag(2.0 * mu * hencky + lam * hencky.sum()) @ turn.T
        np.testing.assert_allclose(stress, expected, atol=2e-3 * np.abs(expected).max())


def test_jelly_has_the_stress_of_its_energy():
    body, (turn,) = soft("jelly"), random_turns(1)
    mu, lam = body.lame
    hencky = np.array([0.4, -0.3, 0.1])
    (strain,), (stress,), _ = answered(body, [strains_of(hencky, turn)])
    expected = turn @ np.diag(mu * np.expm1(2.0 * hencky) + lam * hencky.sum()) @ turn.T
    np.testing.assert_allclose(stress, expected, rtol=1e-4, atol=1e-4 * mu)
    np.testing.assert_allclose(strain, strains_of(hencky, turn), atol=1e-6)


@pytest.mark.parametrize("angle", [20.0, 33.0])
def test_sand_bears_shear_up_to_the_tangent_of_its_angle_times_the_pressure(angle):
    body = soft("sand", friction_angle_deg=angle)
    hencky = np.array([[-0.01 + s, -0.01, -0.01 - s] for s in (0.0, 1e-4, 0.03, 0.08)])
    trials = [strains_of(each, turn) for each, turn in zip(hencky, random_turns(4), strict=True)]
    strain, stress, _ = answered(body, trials)
    pressure = -np.trace(stress, axis1=1, axis2=2) / 3.0
    shear = np.linalg.norm(stress + pressure[:, None, None] * np.eye(3), axis=(1, 2)) / math.sqrt(2.0)
    bearable = math.tan(math.radians(angle)) * pressure
    assert (shear[:2] < bearable[:2]).all()
    np.testing.assert_allclose(shear[2:], bearable[2:], rtol=2e-3)
    # It slides at its volume.
    np.testing.assert_allclose(np.log(np.linalg.det(np.eye(3) + strain)), -0.06, atol=1e-5)


def test_sand_that_was_apart_presses_only_once_it_is_as_dense_as_before():
    body, (turn,) = soft("sand"), random_turns(1)
    (strain,), (stress,), (gained,) = answered(body, [strains_of([0.01, 0.02, 0.0], turn)])
    assert np.abs(stress).max() == 0.0
    assert np.abs(strain).max() == 0.0
    assert gained == pytest.approx(0.03, rel=1e-4)
    _, (still,), (left,) = answered(body, [strains_of([-0.009] * 3, turn)], history=gained)
    assert np.abs(still).max() == 0.0
    assert left == pytest.approx(0.003, rel=1e-2)
    mu, lam = body.lame
    _, (pressed,), (none,) = answered(body, [strains_of([-0.011] * 3, turn)], history=gained)
    np.testing.assert_allclose(pressed, -0.003 * (lam + 2.0 / 3.0 * mu) * np.eye(3), rtol=1e-2, atol=20.0)
    assert none == 0.0


def test_wet_sand_bears_its_cohesion_without_pressure():
    body = soft("wet_sand", cohesion=2000.0)
    _, stress, _ = answered(
        body, [strains_of([s, 0.0, -s], turn) for s, turn in zip((1e-4, 0.02), random_turns(2), strict=True)]
    )
    shear = np.linalg.norm(stress, axis=(1, 2)) / math.sqrt(2.0)
    assert shear[0] == pytest.approx(2.0 * body.lame[0] * 1e-4, rel=1e-3)
    assert shear[1] == pytest.approx(2000.0, rel=2e-3)


def test_clay_flows_at_its_yield_stress_in_tension():
    body = soft("clay")
    mu, lam = body.lame
    for turn in random_turns(2):
        (strain,), (stress,), _ = answered(body, [strains_of([0.08, -0.04, -0.04], turn)])
        mean = np.trace(stress) / 3.0
        mises = math.sqrt(1.5) * np.linalg.norm(stress - mean * np.eye(3))
        assert mises == pytest.approx(5.0e3, rel=1e-3)
        assert np.linalg.det(np.eye(3) + strain) == pytest.approx(1.0, abs=1e-5)
        assert mean == pytest.approx(0.0, abs=1e-3 * (2.0 * mu + 3.0 * lam) * 0.08)


def test_dough_flows_the_faster_the_more_it_is_beyond_its_yield_stress():
    body, (turn,) = soft("dough"), random_turns(1)
    mu, _ = body.lame
    strain, stresses = strains_of([0.05, 0.0, -0.05], turn), []
    for _ in range(400):
        (strain,), (stress,), _ = answered(body, [strain], dt=1.0e-4)
        stresses.append(math.sqrt(1.5) * np.linalg.norm(stress - np.trace(stress) / 3.0 * np.eye(3)))
    start = 2.0 * mu * 0.05 * math.sqrt(3.0)
    expected = 400.0 + (start - 400.0) * np.exp(-mu / 100.0 * 1.0e-4 * np.arange(1, 401))
    np.testing.assert_allclose(stresses, expected, rtol=0.01)
    assert stresses[-1] < 0.8 * start


@pytest.mark.parametrize("exponent", [1.0, 0.5, 0.25])
@pytest.mark.parametrize("rate", [0.1, 10.0])
def test_steady_shear_has_the_stress_of_herschel_and_bulkley(exponent, rate):
    body = soft("cream", young_modulus=1.0e5, yield_stress=60.0, viscosity=20.0, flow_exponent=exponent)
    expected = 60.0 / math.sqrt(3.0) + 20.0 * rate**exponent
    # Long enough for ten times the elastic strain that the stress needs, in steps of a hundredth of it.
    dt = 0.01 * expected / body.lame[0] / rate
    gradient = np.zeros((1, 3, 3))
    gradient[0, 0, 1] = rate * dt
    strain, after = np.zeros((1, 3, 3)), matrices(np.zeros((1, 3, 3)))
    for _ in range(1000):
        move(matrices(strain), matrices(gradient), after)
        strain, stress, _ = answered(body, after.to_numpy(), dt=dt)
    assert stress[0, 0, 1] == pytest.approx(expected, rel=5e-3)


def test_an_exponent_needs_a_viscosity():
    with pytest.raises(ValueError, match="flow_exponent has no meaning without viscosity"):
        soft("clay", flow_exponent=0.5)


def test_snow_breaks_beyond_its_stretches_and_is_harder_once_crushed():
    body, (turn,) = soft("snow"), random_turns(1)
    strain, _, told = answered(body, [strains_of([0.05, 0.0, -0.05], turn), strains_of([-0.1] * 3, turn)])
    stretches = np.sqrt(1.0 + np.linalg.eigvalsh(strain))
    np.testing.assert_allclose(stretches[0], [0.975, 1.0, 1.0075], atol=1e-5)
    assert told[1] == pytest.approx(3.0 * (-0.1 - math.log(0.975)), rel=1e-3)
    same = strains_of([-0.01, 0.0, 0.0], turn)
    _, (fresh,), _ = answered(body, [same])
    _, (crushed,), _ = answered(body, [same], history=-0.05)
    np.testing.assert_allclose(crushed / fresh, math.exp(-10.0 * math.expm1(-0.05)), rtol=1e-3)
    # It gets harder as far as it can be crushed: snow of 400 kg/m³ is ice once 0.44 of its volume are left.
    _, (ice,), _ = answered(body, [same], history=math.log(0.44))
    np.testing.assert_allclose(ice / fresh, math.exp(5.6), rtol=1e-3)


def test_packed_snow_loses_its_cohesion_over_a_crack_and_gets_it_back_where_it_is_crushed():
    body, (turn,) = soft("packed_snow", cell_size=0.02, fracture_energy=2.0), random_turns(1)
    wide = 2.0 / (1.4e6 * 7.5e-3 * 0.02)  # a strain over a cell that takes as much at the strength
    stretched = math.log(1.0075) + 0.5 * wide
    trial = strains_of([stretched, 0.0, 0.0], turn)
    left = np.ones(1)
    answered(body, [trial], cohesion=left)
    np.testing.assert_allclose(left, math.exp(-0.5), rtol=1e-3)
    # It bears so much less in the next step, and nothing in the end; pulled as far, snow that is not packed keeps all.
    strain, _, _ = answered(body, [trial], cohesion=left.copy())
    assert 0.5 * np.log1p(np.linalg.eigvalsh(strain[0])[-1]) == pytest.approx(
        math.exp(-0.5) * math.log(1.0075), rel=1e-3
    )
    for _ in range(20):
        answered(body, [trial], cohesion=left)
    assert left < 1e-4
    crushed = strains_of([-0.05, 0.0, 0.0], turn)
    for history, expected in ((0.1, left[0]), (-0.1, 1.0)):
        again = left.copy()
        answered(body, [crushed], history=history, cohesion=again)
        np.testing.assert_allclose(again, expected)
    kept = np.ones(1)
    answered(soft("snow"), [trial], cohesion=kept)
    assert kept == 1.0
