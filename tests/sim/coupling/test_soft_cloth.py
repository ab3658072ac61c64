"""What soft matter and cloth do to each other: nothing passes, momentum, friction, weight, bits."""

from typing import Any

import numpy as np
import pytest
from thread_counts import digest_of, result_on_threads

from sim.build import build_world
from sim.cloth.sheet import edges_of
from sim.coupling.soft_cloth import SoftClothCoupling, find_crossings, put_back, rims_of
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SPACE = {"gravity": (0.0, 0.0, 0.0), "domain": {"min": (-0.6, -0.6, -0.6), "max": (0.6, 0.6, 0.6)}}
CELL = 0.03
EDGES = tuple({"edge": edge} for edge in ("x-", "x+", "y-", "y+"))
EVERYWHERE = ({"region": {"type": "sphere", "position": (0.0, 0.0, 0.0), "radius": 9.0}},)


def box(size: tuple[float, ...], position: tuple[float, ...], **keys: Any) -> dict[str, Any]:
    return {"shape": {"type": "box", "size": size}, "position": position, **keys}


def matter(*blocks: dict[str, Any], name: str = "matter", material: str = "jelly", **keys: Any) -> dict[str, Any]:
    return {"name": name, "material": material, "cell_size": CELL, "block": blocks, **keys}


def sheet(side: float, count: int, **keys: Any) -> dict[str, Any]:
    shape = {"type": "rectangle", "size": (side, side), "counts": (count, count)}
    return {"name": "sheet", "material": "cotton", "air_density": 0.0, "shape": shape, **keys}


def world_of(**tables: Any) -> Any:
    return build_world(SceneParameters.model_validate(tables), frames_per_second=60)


def momenta(world: Any) -> list[np.ndarray]:
    """Of soft matter and of cloth [N s]."""
    told = [world.solvers[name].diagnostics() for name in ("soft", "cloth")]
    return [np.array([each[f"momentum_{axis}"] for axis in "xyz"]) for each in told]


def gaps(world: Any) -> np.ndarray:
    """Height of each particle over the sheet right below or above it [m]; (n,) of those that have one."""
    cloth = world.solvers["cloth"]
    corners = cloth.state.positions()[cloth.state.host.triangles]
    first, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    found = []
    for x in world.solvers["soft"].view("matter")["position"].astype(float):
        w = x - first
        s, t = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area, (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
        inside = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        found += (w[:, 2] - s * u[:, 2] - t * v[:, 2])[inside].tolist()[:1]
    return np.array(found)


def test_sand_that_falls_into_a_hammock_stays_in_it():
    """Sand of three kilogrammes falls into a sheet of 50 g, which gives way by a third of its width."""
    half = 0.2
    ball = {"shape": {"type": "sphere", "radius": 0.08}, "position": (0.02, 0.0, 0.1), "velocity": (0.5, 0.0, -3.0)}
    world = world_of(
        domain={"min": (-half, -half, -0.4), "max": (half, half, 0.8)},
        soft=[matter(ball, material="sand", young_modulus=5.0e4)],
        cloth=[sheet(2.0 * half + 0.01, 15, pin=EDGES)],
    )
    count, depths = world.solvers["soft"].particles.count, []
    for _ in range(24):
        world.advance_frame()
        over = gaps(world)
        assert len(over) == count
        assert over.min() > 1.0e-4
        depths.append(world.solvers["cloth"].view("sheet")["position"][:, 2].min())
    assert min(depths) < -0.08
    assert world.solvers["soft"].diagnostics()["particles_left"] == 0.0


def test_sand_lies_on_a_held_sheet_as_on_a_floor():
    """To a thousandth of a cell where both are on a plane of nodes, to a part of one between such planes."""
    half = 0.09
    heights = []
    for floor, pinned in ((0.0, 0.4), (-7 * CELL, 0.0), (-6.6 * CELL, 0.0)):
        world = world_of(
            domain={"min": (-half, -half, floor), "max": (half, half, 0.5)},
            soft=[matter(box((2 * half, 2 * half, 0.09), (0.0, 0.0, 0.046)), material="sand", young_modulus=1.0e5)],
            cloth=[sheet(2.0 * half + 0.02, 9, position=(0.0, 0.0, pinned), pin=EVERYWHERE)],
        )
        for _ in range(15):
            world.advance_frame()
        heights.append(np.sort(world.solvers["soft"].view("matter")["position"][:, 2]))
    np.testing.assert_allclose(heights[1], heights[0], atol=0.002 * CELL)
    np.testing.assert_allclose(heights[2], heights[0], atol=0.1 * CELL)


@pytest.mark.parametrize(("mass_per_area", "pull"), [(0.1, 0.0), (5.0, 0.0), (5.0, 6.0)])
def test_a_sheet_gets_what_jelly_loses(mass_per_area, pull):
    """However light the sheet is, it is not thrown back and forth; and what it takes along feels forces once."""
    world = world_of(
        **SPACE,
        force=[{"type": "gravity", "acceleration": (0.0, pull, 0.0)}] if pull else [],
        soft=[matter(box((0.12, 0.12, 0.12), (0.02, 0.0, 0.1), velocity=(0.3, 0.0, -1.5)))],
        cloth=[sheet(0.3, 13, mass_per_area=mass_per_area)],
    )
    before = momenta(world)
    mass = sum(world.solvers[name].diagnostics()["mass"] for name in ("soft", "cloth"))
    for _ in range(10):
        world.advance_frame()
    now = momenta(world)
    now[0][1] -= mass * pull * 10.0 / 60.0
    taken = np.linalg.norm(now[1] - before[1])
    assert taken > 0.5 * mass_per_area * 0.12**2 * 1.5
    np.testing.assert_allclose(sum(now), sum(before), atol=2.0e-6 * np.linalg.norm(before[0]))
    assert world.solvers["cloth"].diagnostics()["max_speed"] < 6.0


def test_a_sheet_glues_nothing_together():
    """Two bodies in touch with both faces of a sheet fly apart as if it were not there."""
    blocks = [
        matter(box((0.12, 0.12, 0.12), (0.0, 0.0, side * 0.065), velocity=(0.0, 0.0, side)), name=name)
        for name, side in (("upper", 1.0), ("lower", -1.0))
    ]
    world = world_of(**SPACE, soft=blocks, cloth=[sheet(0.2, 11)])
    for _ in range(6):
        world.advance_frame()
    for name, side in (("upper", 1.0), ("lower", -1.0)):
        motion = world.solvers["soft"].view(name)
        np.testing.assert_allclose(motion["velocity"][:, 2], side, atol=1.0e-3)
        assert (side * motion["position"][:, 2]).min() > 0.1
    assert world.solvers["cloth"].diagnostics()["max_speed"] < 1.0e-3


def test_a_push_goes_through_a_sheet():
    """What hits one face moves what lies on the other, and parts from it again."""
    blocks = [
        matter(box((0.12, 0.12, 0.12), (0.0, 0.0, 0.075), velocity=(0.0, 0.0, -1.0)), name="upper"),
        matter(box((0.12, 0.12, 0.12), (0.0, 0.0, -0.065)), name="lower"),
    ]
    world = world_of(**SPACE, soft=blocks, cloth=[sheet(0.2, 11)])
    for _ in range(12):
        world.advance_frame()
    upper, lower = (world.solvers["soft"].view(name) for name in ("upper", "lower"))
    assert lower["velocity"][:, 2].mean() < -0.6
    assert upper["velocity"][:, 2].mean() > -0.4
    sag = world.solvers["cloth"].view("sheet")["position"][:, 2]
    assert upper["position"][:, 2].min() > lower["position"][:, 2].max()
    assert lower["position"][:, 2].max() < sag.max()


def test_jelly_slides_to_rest_on_cloth_by_its_friction():
    """Under Coulomb's friction v = v_0 - mu g t; what jelly wobbles passes within some frames."""
    friction = 0.3
    world = world_of(
        domain={"min": (-0.6, -0.2, -0.2), "max": (0.6, 0.2, 0.4)},
        soft=[matter(box((0.18, 0.18, 0.09), (-0.2, 0.0, 0.047), velocity=(1.0, 0.0, 0.0)), friction=friction)],
        cloth=[sheet(1.0, 21, pin=EVERYWHERE, friction=friction)],
    )
    speeds = []
    for _ in range(18):
        world.advance_frame()
        speeds.append(world.solvers["soft"].view("matter")["velocity"][:, 0].mean())
    slowing = -np.polyfit(np.arange(len(speeds)) / 60.0, speeds, 1)[0]
    assert slowing == pytest.approx(friction * 9.81, rel=0.1)


def test_a_blanket_lies_on_jelly_and_does_not_sink_in():
    world = world_of(
        domain={"min": (-0.2, -0.2, 0.0), "max": (0.2, 0.2, 0.4)},
        soft=[matter(box((0.18, 0.18, 0.12), (0.0, 0.0, 0.06)))],
        cloth=[sheet(0.26, 14, position=(0.0, 0.0, 0.15), air_density=1.2)],
    )
    for _ in range(45):
        world.advance_frame()
    assert gaps(world).max() < -1.0e-4
    jelly, cloth = (world.solvers[name].view(body) for name, body in (("soft", "matter"), ("cloth", "sheet")))
    top = jelly["position"][:, 2].max()
    over = cloth["position"][(np.abs(cloth["position"][:, :2]) < 0.07).all(axis=1), 2]
    assert ((over > top) & (over < top + CELL)).all()
    assert np.abs(cloth["velocity"]).max() < 0.4
    assert cloth["position"][:, 2].min() < top - 0.02  # its rim hangs down


def test_what_has_crossed_a_triangle_is_put_back_to_its_side():
    """Particles are put behind a sheet whose nodes move past others: some cross it down, some are crossed by it."""
    world = world_of(
        **SPACE,
        soft=[matter(box((0.12, 0.12, 0.06), (0.0, 0.0, 0.031)), box((0.12, 0.12, 0.06), (0.0, 0.0, -0.031)))],
        cloth=[sheet(0.2, 11, pin=EVERYWHERE)],
    )
    world.advance_frame()
    coupling = next(each for each in world._couplings if isinstance(each, SoftClothCoupling))
    particles, sheets, met, blocks = coupling._soft.particles, coupling._sheets, coupling._met, coupling._blocks
    coupling._find_hidden(blocks)
    nodes = sheets.before.to_numpy()
    raised = nodes + np.where(nodes[:, :1] > 0.0, 0.012, 0.0) * np.array([0.0, 0.0, 1.0])
    sheets.place.from_numpy(raised.astype(np.float32))
    start = particles.position.to_numpy()
    thrown = start.copy()
    falls = (start[:, 0] < -0.02) & (np.abs(start[:, 2] - 0.01) < 0.01)
    is_hit = (start[:, 0] > 0.02) & (start[:, 2] > 0.0) & (start[:, 2] < 0.011)
    thrown[falls, 2] -= 0.02
    particles.position.from_numpy(thrown)
    assert find_crossings(blocks, particles, sheets, met) == falls.sum() + is_hit.sum() > 20
    put_back(particles, sheets, met, coupling._soft.box, 1.0e-4)
    now = particles.position.to_numpy()
    np.testing.assert_allclose(now[falls, 2], 1.0e-4, atol=1.0e-6)
    np.testing.assert_allclose(now[is_hit, 2], 0.0121, atol=1.0e-6)
    others = ~(falls | is_hit)
    np.testing.assert_array_equal(now[others], thrown[others])
    assert find_crossings(blocks, particles, sheets, met) == 0


def test_a_sheet_that_turns_about_a_line_meets_all_that_it_sweeps_over():
    """Half of a sheet folds up by 30 degrees; how far particles are from planes does not change evenly meanwhile."""
    world = world_of(
        **SPACE,
        soft=[matter(box((0.16, 0.12, 0.1), (0.0, 0.0, 0.052)))],
        cloth=[sheet(0.2, 5, pin=EVERYWHERE)],
    )
    world.advance_frame()
    coupling = next(each for each in world._couplings if isinstance(each, SoftClothCoupling))
    particles, sheets, met, blocks = coupling._soft.particles, coupling._sheets, coupling._met, coupling._blocks
    coupling._find_hidden(blocks)
    nodes = sheets.before.to_numpy().astype(np.float64)
    slope, rises = np.radians(30.0), nodes[:, 0] > 0.0
    turned = nodes.copy()
    turned[rises, 0], turned[rises, 2] = nodes[rises, 0] * np.cos(slope), nodes[rises, 0] * np.sin(slope)
    sheets.place.from_numpy(turned.astype(np.float32))
    x, _, z = particles.position.to_numpy().astype(np.float64).T
    swept = (x > 0.002) & (x < 0.1 * np.cos(slope) - 0.002) & (z < x * np.tan(slope) - 1.0e-4)
    assert find_crossings(blocks, particles, sheets, met) == swept.sum() > 20


def run_in_hammock(checkpoint: str, resume: bool) -> str:
    """Digest of sand in a hammock, whole or from a checkpoint on."""
    ball = {"shape": {"type": "sphere", "radius": 0.06}, "position": (0.0, 0.0, 0.08), "velocity": (0.3, 0.0, -2.0)}
    world = world_of(
        domain={"min": (-0.3, -0.3, -0.4), "max": (0.3, 0.3, 0.6)},
        soft=[matter(ball, material="sand", young_modulus=5.0e4)],
        cloth=[sheet(0.3, 11, pin=EDGES)],
    )
    if resume:
        with np.load(checkpoint) as arrays:
            world.restore(3, dict(arrays))
    else:
        for _ in range(3):
            world.advance_frame()
        np.savez(checkpoint, **world.checkpoint())
    for _ in range(3):
        world.advance_frame()
    return digest_of(world.checkpoint())


@pytest.mark.slow
def test_bits_are_those_of_a_run_that_was_not_killed_whatever_the_threads(taichi_cpu, tmp_path):
    if taichi_cpu != "cpu":
        pytest.skip("compares numbers of threads")
    checkpoint = str(tmp_path / "checkpoint.npz")
    whole = result_on_threads(1, run_in_hammock, checkpoint, False)
    assert result_on_threads(2, run_in_hammock, checkpoint, True) == whole


def test_rims_are_the_sides_and_corners_of_one_triangle():
    """A square of two triangles: all sides but the diagonal are rims, and all corners."""
    triangles = np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32)
    edges = edges_of(triangles)
    assert rims_of(triangles, edges.of_side).tolist() == [0b111110, 0b111101]


def test_fluid_beside_both_is_refused_by_name():
    water = {"name": "water", "particle_radius": 0.01, "block": [box((0.1, 0.1, 0.1), (0.0, 0.0, 0.3))]}
    jelly = matter(box((0.12, 0.12, 0.12), (0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="fluid would not feel the cloth; remove one of the three"):
        world_of(**SPACE, fluid=[water], soft=[jelly], cloth=[sheet(0.2, 5)])


def test_explicit_cloth_is_refused_by_name():
    jelly = matter(box((0.12, 0.12, 0.12), (0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match='"explicit" takes thousands of substeps a frame'):
        world_of(**SPACE, soft=[jelly], cloth=[sheet(0.2, 5, integrator="explicit")])
