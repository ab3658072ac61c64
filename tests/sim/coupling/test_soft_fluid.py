"""What fluid and soft matter do to each other: momentum, floats, waves, bits, and what cannot be."""

from typing import Any

import numpy as np
import pytest
from thread_counts import digest_of, result_on_threads

from sim.build import build_world
from sim.fluid.solvers import SOLVERS
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

EVERY_FACE = ("x-", "x+", "y-", "y+", "z-", "z+")
SPACE = {
    "gravity": (0.0, 0.0, 0.0),
    "domain": {"min": (-0.4, -0.4, -0.4), "max": (0.4, 0.4, 0.4), "open_faces": EVERY_FACE},
}
CELL = 0.03
OTHERS = [pytest.param(each, marks=pytest.mark.slow) for each in sorted(SOLVERS) if each != "dfsph"]


def box(size: tuple[float, ...], position: tuple[float, ...] = (0.0, 0.0, 0.0), **keys: Any) -> dict[str, Any]:
    return {"shape": {"type": "box", "size": size}, "position": position, **keys}


def water(*blocks: dict[str, Any], solver: str = "dfsph") -> dict[str, Any]:
    return {"name": "water", "solver": solver, "particle_radius": 0.01, "block": blocks}


def jelly(*blocks: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return {"name": "jelly", "material": "jelly", "cell_size": CELL, "block": blocks, **keys}


def world_of(**tables: Any) -> Any:
    return build_world(SceneParameters.model_validate(tables), frames_per_second=60)


def drop_on_jelly_and_ball(solver: str) -> Any:
    """A drop that hits jelly, which a ball hits from below."""
    drop = box((0.1, 0.1, 0.1), (0.0, 0.0, 0.12), velocity=(0.3, 0.0, -1.5))
    ball = {"name": "ball", "kind": "dynamic", "shape": {"type": "sphere", "radius": 0.05}, "density": 500.0}
    ball |= {"position": (0.0, 0.05, -0.12), "velocity": (0.0, 0.0, 2.0)}
    return world_of(**SPACE, fluid=[water(drop, solver=solver)], soft=[jelly(box((0.2, 0.2, 0.12)))], rigid=[ball])


def momenta(world: Any) -> list[np.ndarray]:
    """Of the fluid, of soft matter and of the bodies [N s]."""
    told = [world.solvers[name].diagnostics() for name in ("water", "soft")]
    bodies = world.solvers["rigid"].bodies
    particles = [np.array([each[f"momentum_{axis}"] for axis in "xyz"]) for each in told]
    return [*particles, (bodies.mass[:, None] * bodies.velocity).sum(axis=0)]


@pytest.mark.parametrize("solver", ["dfsph", *OTHERS])
def test_jelly_between_a_drop_and_a_ball_takes_what_they_lose(solver):
    world = drop_on_jelly_and_ball(solver)
    before = momenta(world)
    for _ in range(4):
        world.advance_frame()
    now = momenta(world)
    scale = np.linalg.norm(before[0])
    assert all(np.linalg.norm(a - b) > 0.1 * scale for a, b in zip(now, before, strict=True))
    np.testing.assert_allclose(sum(now), sum(before), atol=1.0e-6 * scale)


@pytest.mark.parametrize("solver", ["dfsph", *OTHERS])
def test_what_is_lighter_floats_at_its_depth_and_what_is_heavier_sinks(solver):
    level, edge, density = 0.2, 0.12, 500.0
    height = level + (0.5 - density / 1000.0) * edge  # of the centre, in a pool whose level stays
    cube = (edge, edge, edge)
    clay = {"name": "clay", "material": "clay", "young_modulus": 2.0e4, "cell_size": CELL, "density": 1500.0}
    world = world_of(
        domain={"min": (-0.2, -0.11, 0.0), "max": (0.2, 0.11, 0.4)},
        fluid=[water(box((0.4, 0.22, level), (0.0, 0.0, 0.5 * level)), solver=solver)],
        soft=[
            jelly(box(cube, (-0.1, 0.0, height)), density=density),
            clay | {"block": [box(cube, (0.1, 0.0, 0.12))]},
        ],
    )
    heights = []
    for _ in range(40):
        world.advance_frame()
        heights.append(world.solvers["soft"].view("jelly")["position"][:, 2].mean())
    floating, sunk = (world.solvers["soft"].view(name)["position"] for name in ("jelly", "clay"))
    assert np.mean(heights[-15:]) == pytest.approx(height, abs=0.2 * CELL)
    assert np.percentile(sunk[:, 2], 5.0) < 0.035  # a layer of the fluid's particles stays below, as under rigid bodies
    drops = world.solvers["water"].view("water")["position"]
    for place in (floating, sunk):
        low, high = np.percentile(place, (2.0, 98.0), axis=0)
        assert not ((drops > low + 0.01) & (drops < high - 0.01)).all(axis=1).any()


def test_water_rests_on_a_slab_nearly_as_on_a_floor():
    half = 0.08
    rubber = {"name": "slab", "material": "rubber", "young_modulus": 1.0e5, "cell_size": 0.04, "friction": 0.0}
    world = world_of(
        domain={"min": (-half, -half, 0.0), "max": (half, half, 0.4)},
        fluid=[water(box((2 * half, 2 * half, 0.08), (0.0, 0.0, 0.12)))],
        soft=[rubber | {"block": [box((2 * half, 2 * half, 0.08), (0.0, 0.0, 0.04))]}],
    )
    for _ in range(30):
        world.advance_frame()
    slab = world.solvers["soft"].view("slab")["position"][:, 2]
    off = (world.solvers["water"].view("water")["position"][:, 2] - np.median(slab[slab > 0.065]) - 0.01) / 0.02
    lowest = off[off < 1.0]
    assert 58 <= len(lowest) <= 66  # 64 of a lattice
    assert 0.35 < np.median(lowest) < 0.55  # 0.52 on a floor
    assert np.median(off[(off > 1.0) & (off < 2.0)]) == pytest.approx(1.5, abs=0.1)
    assert lowest.min() > 0.2


def test_a_wave_carries_a_heap_of_sand_away():
    """Without the wave the heap's centre would stay where it is."""
    world = world_of(
        domain={"min": (-0.5, -0.09, 0.0), "max": (0.5, 0.09, 0.5)},
        fluid=[water(box((0.3, 0.18, 0.24), (-0.35, 0.0, 0.12)))],
        soft=[
            {"name": "heap", "material": "sand", "young_modulus": 5.0e4, "cell_size": CELL}
            | {"block": [box((0.12, 0.18, 0.1), (0.1, 0.0, 0.05))]}
        ],
    )
    centres = []
    for _ in range(24):
        world.advance_frame()
        centres.append(world.solvers["soft"].view("heap")["position"][:, 0].mean())
    assert centres[6] == pytest.approx(0.1, abs=1.0e-3)  # before it comes
    assert centres[-1] > 0.15
    assert world.solvers["soft"].diagnostics()["particles_left"] == 0.0


def run_drop(checkpoint: str, resume: bool) -> str:
    """Digest of a drop on jelly and a ball, whole or from a checkpoint on."""
    world = drop_on_jelly_and_ball("dfsph")
    if resume:
        with np.load(checkpoint) as arrays:
            world.restore(2, dict(arrays))
    else:
        world.advance_frame()
        world.advance_frame()
        np.savez(checkpoint, **world.checkpoint())
    world.advance_frame()
    world.advance_frame()
    return digest_of(world.checkpoint())


@pytest.mark.slow
def test_bits_are_those_of_a_run_that_was_not_killed_whatever_the_threads(taichi_cpu, tmp_path):
    if taichi_cpu != "cpu":
        pytest.skip("compares numbers of threads")
    checkpoint = str(tmp_path / "checkpoint.npz")
    whole = result_on_threads(1, run_drop, checkpoint, False)
    assert result_on_threads(2, run_drop, checkpoint, True) == whole


def test_soft_matter_that_has_left_is_in_no_ones_way():
    out = box((0.1, 0.1, 0.12), (0.36, 0.0, 0.0), velocity=(6.0, 0.0, 0.0))
    behind = box((0.08, 0.08, 0.08), (0.2, 0.0, 0.0), velocity=(6.0, 0.0, 0.0))
    world = world_of(**SPACE, fluid=[water(behind)], soft=[jelly(out)])
    for _ in range(3):
        world.advance_frame()
    assert world.solvers["soft"].diagnostics()["particle_count"] == 0.0
    for _ in range(2):
        world.advance_frame()
    assert world.solvers["water"].diagnostics()["particle_count"] == 0.0


def test_cells_that_fluid_would_slip_through_are_refused():
    with pytest.raises(
        ValueError, match=r'soft "jelly": cell_size of 0.06 m would let fluid through, .* use 0.05 m or less'
    ):
        world_of(
            **SPACE,
            fluid=[water(box((0.1, 0.1, 0.1), (0.0, 0.0, 0.3)))],
            soft=[jelly(box((0.2, 0.2, 0.2)), cell_size=0.06)],
        )
