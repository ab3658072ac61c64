"""Several fluids in one tank."""

import numpy as np
import pytest
from small_fluids import lattice

from sim.build import build_world
from sim.fluid.parameters import LARGEST_DENSITY_CONTRAST, FluidParameters, shared_conflicts
from sim.scene import SceneParameters

TANK = {"min": (-0.06, -0.06, 0.0), "max": (0.06, 0.06, 0.3)}


def layers(lower_density: float, upper_density: float, **shared):
    """A tank of 6 x 6 particles with five layers of one fluid below five of another."""

    def fluid(name: str, density: float, height: float):
        box = {"shape": {"type": "box", "size": (0.12, 0.12, 0.1)}, "position": (0, 0, height)}
        return {"name": name, "rest_density": density, "block": [box], **shared}

    scene = {"domain": TANK, "fluid": [fluid("lower", lower_density, 0.05), fluid("upper", upper_density, 0.15)]}
    return build_world(SceneParameters.model_validate(scene), frames_per_second=60)


def heights(world) -> tuple[float, float]:
    arrays = world.snapshots()
    return tuple(float(arrays[name].arrays["position"][:, 2].mean()) for name in ("lower", "upper"))


def run(world, seconds: float):
    for _ in range(round(60 * seconds)):
        report = world.advance_frame()
    return report.diagnostics["lower+upper"]


@pytest.mark.parametrize(
    ("solver", "contrast"),
    [
        ("dfsph", LARGEST_DENSITY_CONTRAST),
        *(pytest.param("wcsph", contrast, marks=pytest.mark.slow) for contrast in (2.0, LARGEST_DENSITY_CONTRAST)),
        pytest.param("pcisph", LARGEST_DENSITY_CONTRAST, marks=pytest.mark.slow),
    ],
)
def test_a_light_fluid_stays_at_rest_on_a_heavy_one(taichi_cpu, solver, contrast):
    world = layers(1000.0, 1000.0 / contrast, solver=solver)
    assert run(world, 1.0).get("not_converged", 0.0) == 0.0
    lower, upper = world.snapshots()["lower"], world.snapshots()["upper"]
    # The interface, 0.1 m high at the start, stays sharp to a particle's diameter.
    assert lower.arrays["position"][:, 2].max() < 0.1 + 0.02
    assert upper.arrays["position"][:, 2].min() > 0.1 - 0.02
    # Each keeps its own density: the compression of the column is below 1 % by the choice of the sound speed.
    np.testing.assert_allclose(np.median(lower.arrays["density"]), 1000.0, rtol=0.02)
    np.testing.assert_allclose(np.median(upper.arrays["density"]), 1000.0 / contrast, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "contrast"),
    [("wcsph", 2.0), *((solver, LARGEST_DENSITY_CONTRAST) for solver in ("wcsph", "dfsph", "pcisph"))],
)
def test_a_heavy_fluid_sinks_through_a_light_one(taichi_cpu, solver, contrast):
    world = layers(1000.0 / contrast, 1000.0, solver=solver)
    # At a contrast of 2 the overturning takes 2 s, as it starts from nothing but rounding.
    run(world, 3.0 if contrast == 2.0 else 1.5)
    light, heavy = heights(world)
    # From 0.05 and 0.15 m they have changed places, but for the drops that are still on their way.
    assert light > heavy + 0.02


def test_two_fluids_of_one_material_are_one_fluid(taichi_cpu):
    two = layers(1000.0, 1000.0)
    box = {"shape": {"type": "box", "size": (0.12, 0.12, 0.2)}, "position": (0, 0, 0.1)}
    scene = {"domain": TANK, "fluid": [{"name": "both", "block": [box]}]}
    one = build_world(SceneParameters.model_validate(scene), frames_per_second=60)
    for _ in range(6):
        two.advance_frame()
        one.advance_frame()
    both = one.snapshots()["both"].arrays["position"]
    parts = [two.snapshots()[name].arrays["position"] for name in ("lower", "upper")]
    both, parts = (np.sort(each, axis=0) for each in (both, np.concatenate(parts)))
    # The same sums in another order: float32 rounding that a tenth of a second of flow amplifies.
    np.testing.assert_allclose(parts, both, atol=2.0e-3)


def test_the_first_fluid_keeps_a_place_that_two_want(taichi_cpu):
    box = {"shape": {"type": "box", "size": (0.12, 0.12, 0.1)}, "position": (0, 0, 0.05)}
    whole = {"shape": {"type": "box", "size": (0.12, 0.12, 0.2)}, "position": (0, 0, 0.1)}
    scene = {"domain": TANK, "fluid": [{"name": "a", "block": [box]}, {"name": "b", "block": [whole]}]}
    snapshots = build_world(SceneParameters.model_validate(scene), frames_per_second=60).snapshots()
    counts = {name: len(snapshots[name].arrays["position"]) for name in "ab"}
    assert counts == {"a": 180, "b": 180}
    assert len(lattice((-0.06, -0.06, 0.0), (0.06, 0.06, 0.1), 0.02)) == 180


def test_each_fluid_of_a_tank_is_counted(taichi_cpu):
    def diagnostics(*heights: float):
        fluids, bottom = [], 0.0
        for name, height in zip("ab", heights, strict=False):
            box = {"shape": {"type": "box", "size": (0.12, 0.12, height)}, "position": (0, 0, bottom + height / 2)}
            fluids.append({"name": name, "block": [box]})
            bottom += height
        scene = SceneParameters.model_validate({"domain": TANK, "fluid": fluids})
        (of_tank,) = build_world(scene, frames_per_second=60).diagnostics().values()
        return of_tank

    of_two = diagnostics(0.04, 0.1)
    assert (of_two["particle_count"], of_two["particle_count_a"], of_two["particle_count_b"]) == (252.0, 72.0, 180.0)
    assert "particle_count_a" not in diagnostics(0.04)


def test_momentum_of_mixing_fluids_is_conserved(taichi_cpu):
    free = {"domain": {"min": (-1, -1, -1), "max": (1, 1, 1), "open_faces": ("x-", "x+", "y-", "y+", "z-", "z+")}}
    cube = {"type": "box", "size": (0.1, 0.1, 0.1)}
    fluids = [
        {"name": "a", "block": [{"shape": cube, "position": (-0.051, 0, 0), "velocity": (1, 0, 0)}]},
        {
            "name": "b",
            "rest_density": 200.0,
            "viscosity": 1.0e-3,
            "block": [{"shape": cube, "position": (0.051, 0.02, 0), "velocity": (-1, 0, 0)}],
        },
    ]
    scene = SceneParameters.model_validate({**free, "gravity": (0, 0, 0), "fluid": fluids})
    world = build_world(scene, frames_per_second=60)
    before = world.diagnostics()["a+b"]
    for _ in range(6):
        world.advance_frame()
    after = world.diagnostics()["a+b"]
    for axis in "xyz":
        # Pair forces cancel to float32 rounding of each of some hundred kicks; the scale is that of each cube.
        assert abs(after[f"momentum_{axis}"] - before[f"momentum_{axis}"]) < 1.0e-5 * before["mass"]
    assert after["kinetic_energy"] < before["kinetic_energy"]


def test_what_fluids_must_share_is_told_with_both_places():
    def fluid(**more) -> FluidParameters:
        box = {"shape": {"type": "box", "size": (1, 1, 1)}}
        return FluidParameters.model_validate({"name": "water", "block": [box], **more})

    assert shared_conflicts([fluid(), fluid(rest_density=800.0, viscosity=1.0, surface_tension=0.1)]) == []
    ((number, key, message),) = shared_conflicts([fluid(), fluid(cfl=0.5)])
    assert (number, key) == (1, "cfl")
    assert message == 'is 0.5, but 1 in fluid[0] "water"; all fluids of a tank share it'
    ((_, key, message),) = shared_conflicts([fluid(), fluid(rest_density=1.2)])
    assert key == "rest_density"
    assert "by a factor of 10 at most" in message
