"""Dye against the theory of diffusion: its profile, its total, its range, and what takes it along."""

import numpy as np
import pytest
from scipy.special import erf
from small_fluids import EARTH, EVERY_FACE, lattice, run
from thread_counts import digest_of

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.fluid.boundary_akinci2012 import BoundarySamples, domain_wall_samples
from sim.fluid.parameters import FluidParameters
from sim.fluid.solvers import SOLVERS
from sim.fluid.tank import FluidStart
from sim.scene import SceneParameters

SPACING = 0.01
OPEN_SPACE = DomainParameters(min=(-0.5, -0.5, -0.5), max=(0.5, 0.5, 0.5), open_faces=EVERY_FACE)
BOX = {"type": "box", "size": (0.1, 0.1, 0.1)}
HALVES = [{"shape": BOX, "dye": 1.0}, {"shape": BOX}]


def dyed(
    positions, dye, domain=OPEN_SPACE, *, gravity=(0.0, 0.0, 0.0), velocities=None, fluids=None, phase=None, **keys
):
    """A tank of particles at the positions, whose first fluid has the keys."""
    table = {"name": "water", "solver": "dfsph", "particle_radius": SPACING / 2, "block": HALVES, **keys}
    fluids = fluids or (FluidParameters.model_validate(table),)
    start = FluidStart(
        fluids,
        domain=domain,
        gravity=gravity,
        positions=positions,
        velocities=np.zeros_like(positions) if velocities is None else velocities,
        phase=phase,
        dye=np.asarray(dye, dtype=np.float32),
        boundary=BoundarySamples.of_bodies(domain_wall_samples(domain, SPACING, 2.0)),
    )
    return SOLVERS[fluids[0].solver](start)


def dye_of(fluid, name="water"):
    return fluid.snapshots()[name].arrays["dye"].astype(np.float64)


def step_profile(x, diffusivity, time, half_length):
    """Concentration in -L < x < L that was 1 for x < 0 and 0 for x > 0; images of the step behind both closed ends."""
    width = np.sqrt(4.0 * diffusivity * time)
    images = range(-6, 7)
    return 0.5 - 0.5 * sum((-1) ** n * erf((x - 2.0 * n * half_length) / width) for n in images)


@pytest.mark.parametrize("diffusivity", [2.0e-4, 2.0e-2])
def test_a_step_becomes_the_profile_of_theory(taichi_cpu, diffusivity):
    """Forty layers at rest; the larger diffusivity takes many parts of each step."""
    points = lattice((-0.2, -0.04, -0.04), (0.2, 0.04, 0.04), SPACING)
    fluid = dyed(points, points[:, 0] < 0.0, dye_diffusivity=diffusivity)
    time = 2.0e-3 / diffusivity  # sqrt(4 D t) is nine spacings
    for _ in range(20):
        fluid.substep(time / 20)
    assert np.abs(fluid.snapshots()["water"].arrays["position"] - points).max() < 1e-3 * SPACING
    # The second moment of the kernel over the lattice is 0.6 % off, and the surface has fewer neighbours on its sides
    # only, where nothing is to be exchanged.
    found = dye_of(fluid)
    assert np.abs(found - step_profile(points[:, 0], diffusivity, time, 0.2)).max() < 0.02
    middle = np.abs(points[:, 1:]).max(axis=1) < 0.02
    assert np.abs((found - step_profile(points[:, 0], diffusivity, time, 0.2))[middle]).max() < 0.01


def test_disordered_particles_diffuse_as_fast(taichi_cpu):
    """A column of water that has collapsed and settled; the second moment of a layer of dye grows by 2 D t."""
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.4, 0.08, 0.4), open_faces=("z+",))
    points = lattice((0.0, 0.0, 0.0), (0.2, 0.08, 0.16), SPACING)
    fluid = dyed(points, points[:, 0] < 0.1, domain, gravity=EARTH, dye_diffusivity=0.0)
    run(fluid, 1.5)
    settled = fluid.snapshots()["water"].arrays["position"]
    diffusivity, time = 2.0e-4, 10.0
    at_rest = dyed(settled, settled[:, 0] < 0.2, domain, dye_diffusivity=diffusivity)
    at_rest.compute_density()
    at_rest.dye.diffuse(at_rest.particles, at_rest.tank.on_device, time)
    found, expected = dye_of(at_rest), step_profile(settled[:, 0] - 0.2, diffusivity, time, 0.2)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03


@pytest.mark.parametrize("solver", ["wcsph", "dfsph", "pcisph"])
def test_the_dye_of_a_splash_stays_the_same_and_in_its_range(taichi_cpu, solver):
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.3, 0.08, 0.4), open_faces=())
    points = lattice((0.0, 0.0, 0.0), (0.12, 0.08, 0.2), SPACING)
    fluid = dyed(points, points[:, 2] > 0.1, domain, gravity=EARTH, solver=solver, dye_diffusivity=1.0e-3)
    before = dye_of(fluid).sum()
    run(fluid, 0.4)
    after = dye_of(fluid)
    assert after.sum() == pytest.approx(before, rel=1e-6)
    assert after.min() > -1e-6 and after.max() < 1.0 + 1e-6
    assert after.std() < 0.4  # of 0.5 at the start: it has mixed


def test_dye_goes_with_its_particles_and_not_beyond_them_without_diffusion(taichi_cpu):
    points = lattice((-0.05, -0.05, -0.05), (0.05, 0.05, 0.05), SPACING)
    dye = np.random.default_rng(0).uniform(size=len(points))
    fluid = dyed(points, dye, dye_diffusivity=0.0, velocities=np.full_like(points, 0.5))
    run(fluid, 0.3)
    moved = fluid.snapshots()["water"].arrays
    np.testing.assert_array_equal(moved["dye"], dye.astype(np.float32))
    assert (moved["position"] - points).min() > 0.1


def side_by_side(points, dye, *diffusivities):
    """Two fluids, left and right of x = 0, which do not flow."""
    keys = {"solver": "dfsph", "particle_radius": SPACING / 2, "block": HALVES}
    fluids = tuple(
        FluidParameters.model_validate({"name": name, **keys, "dye_diffusivity": each})
        for name, each in zip(("left", "right"), diffusivities, strict=True)
    )
    return dyed(points, dye, fluids=fluids, phase=(points[:, 0] > 0.0).astype(np.int32))


def test_dye_goes_from_one_fluid_into_the_other(taichi_cpu):
    """Of two media, one four times as diffusive: profile of Carslaw & Jaeger, the dye of both together stays."""
    points = lattice((-0.2, -0.04, -0.04), (0.2, 0.04, 0.04), SPACING)
    left, right = 2.0e-3, 5.0e-4
    fluid = side_by_side(points, points[:, 0] < 0.0, left, right)
    before = float(np.count_nonzero(points[:, 0] < 0.0))
    time = 2.0e-3 / left
    for _ in range(20):
        fluid.substep(time / 20)
    names = "left", "right"
    arrays = [fluid.snapshots()[name].arrays for name in names]
    assert sum(each["dye"].astype(np.float64).sum() for each in arrays) == pytest.approx(before, rel=1e-6)
    # The flux is continuous: c is sqrt(D_left)/(sqrt(D_left) + sqrt(D_right)) on the interface, and stays so.
    ratio = np.sqrt(right / left)
    for each, side in zip(arrays, (left, right), strict=True):
        x = each["position"][:, 0].astype(np.float64)
        reached = erf(np.abs(x) / np.sqrt(4.0 * side * time))
        expected = (1.0 + ratio * reached) / (1.0 + ratio) if side == left else (1.0 - reached) / (1.0 + ratio)
        assert np.abs(each["dye"] - expected)[np.abs(x) < 0.1].max() < 0.025


@pytest.mark.parametrize("solver", ["dfsph", pytest.param("wcsph", marks=pytest.mark.slow)])
def test_the_dye_of_two_fluids_that_change_places_stays_the_same(taichi_cpu, solver):
    def fluid(name, density, height, dye):
        shape = {"type": "box", "size": (0.1, 0.1, 0.05)}
        block = {"shape": shape, "position": (0.05, 0.05, height), "dye": dye}
        keys = {"solver": solver, "particle_radius": SPACING / 2, "dye_diffusivity": 1.0e-4}
        return {"name": name, "rest_density": density, "block": [block], **keys}

    scene = {
        "domain": {"min": (0.0, 0.0, 0.0), "max": (0.1, 0.1, 0.2)},
        "fluid": [fluid("oil", 700.0, 0.025, 1.0), fluid("water", 1000.0, 0.075, 0.0)],
    }
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=30.0)

    def dyes():
        return [world.snapshots()[name].arrays["dye"].astype(np.float64) for name in ("oil", "water")]

    before = sum(each.sum() for each in dyes())
    for _ in range(60):
        world.advance_frame()
    oil, water = dyes()
    assert oil.sum() + water.sum() == pytest.approx(before, rel=1e-6)
    assert water.mean() > 0.1
    assert min(oil.min(), water.min()) > -1e-6 and max(oil.max(), water.max()) < 1.0 + 1e-6


def test_dye_stays_in_its_fluid_where_the_other_takes_none(taichi_cpu):
    points = lattice((-0.1, -0.03, -0.03), (0.1, 0.03, 0.03), SPACING)
    fluid = side_by_side(points, 0.25 + 0.5 * (points[:, 0] > 0.0), 1.0e-2, 0.0)
    for _ in range(10):
        fluid.substep(1e-3)
    np.testing.assert_array_equal(dye_of(fluid, "left"), 0.25)
    np.testing.assert_array_equal(dye_of(fluid, "right"), 0.75)


def test_a_fluid_without_dye_has_none_in_its_frames(taichi_cpu):
    points = lattice((-0.05, -0.05, -0.05), (0.05, 0.05, 0.05), SPACING)
    fluid = dyed(points, np.zeros(len(points)), block=[{"shape": BOX}])
    assert "dye" not in fluid.snapshots()["water"].arrays
    assert "dye" not in fluid.checkpoint()


POUR = {
    "domain": {"min": (0.0, 0.0, 0.0), "max": (0.2, 0.1, 0.3), "open_faces": ()},
    "fluid": [
        {
            "name": "water",
            "solver": "dfsph",
            "particle_radius": 0.008,
            "dye_diffusivity": 1.0e-4,
            "block": [{"shape": {"type": "box", "size": (0.2, 0.1, 0.06)}, "position": (0.1, 0.05, 0.03), "dye": 0.25}],
            "emitter": [
                {
                    "shape": {"type": "disc", "radius": 0.02},
                    "position": (0.1, 0.05, 0.2),
                    "direction": (0.0, 0.0, -1.0),
                    "speed": 0.5,
                    "dye": 1.0,
                }
            ],
        }
    ],
}


def test_what_an_emitter_brings_has_its_dye_and_a_run_continues_to_the_bit(taichi_cpu):
    scene = SceneParameters.model_validate(POUR)
    whole, resumed = (build_world(scene, frames_per_second=30.0) for _ in range(2))
    first = whole.snapshots()["water"].arrays["dye"]
    assert (first == 0.25).all()
    for _ in range(6):
        whole.advance_frame()
    arrays = whole.snapshots()["water"].arrays
    emitted = len(arrays["dye"]) - len(first)
    assert emitted > 20
    total = 0.25 * len(first) + 1.0 * emitted
    assert arrays["dye"].astype(np.float64).sum() == pytest.approx(total, rel=1e-6)
    resumed.restore(6, whole.checkpoint())
    for world in (whole, resumed):
        world.advance_frame()
    assert digest_of(whole.checkpoint()) == digest_of(resumed.checkpoint())


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ({"block": [{"shape": BOX, "dye": 0.5}]}, "has a dye of 0.5 everywhere, and nothing to mix with"),
        ({"block": [{"shape": BOX}], "dye_diffusivity": 1e-9}, "dye_diffusivity has no meaning without dye"),
        ({"block": [{"shape": BOX, "dye": 1.5}]}, "less than or equal to 1"),
    ],
)
def test_dye_that_cannot_act_is_refused(keys, rule):
    with pytest.raises(ValueError, match=rule):
        SceneParameters.model_validate({"fluid": [{"name": "water", **keys}]})


def test_a_fluid_of_one_dye_may_mix_with_another(taichi_cpu):
    first = {"name": "red", "block": [{"shape": BOX, "dye": 1.0}]}
    other = {"name": "clear", "block": [{"shape": BOX}], "dye_diffusivity": 1e-9}
    scene = SceneParameters.model_validate({"fluid": [first, other]})
    assert [fluid.has_dye for fluid in scene.fluid] == [True, False]
