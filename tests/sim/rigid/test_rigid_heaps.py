"""Many bodies at once: cradles, walls and heaps."""

import itertools
import math

import numpy as np
import pytest
import trimesh
from rigid_scenes import advance, ball, body, cube, energy, in_room, in_space

from sim.core.domain import DomainParameters
from sim.rigid.solver import SLEEP_TIME_S, RigidSolver


@pytest.mark.parametrize("gap_mm", [0.0, 0.2, 0.5, 2.0, 10.0])
@pytest.mark.parametrize("restitution", [0.9, 1.0])
def test_a_blow_goes_through_a_cradle_of_five_balls_one_after_the_other(gap_mm, restitution):
    radius = 0.05
    pitch = 2.0 * radius + 1e-3 * gap_mm
    hit = body("hit", ball(radius), (-pitch - 0.05, 0, 1), velocity=(1.0, 0.0, 0.0), restitution=restitution)
    others = [body(f"b{k}", ball(radius), (k * pitch, 0, 1), restitution=restitution) for k in range(4)]
    solver = in_space(hit, *others)
    start = energy(solver)
    advance(solver, 0.3)
    # Each of four blows hands on (1 + e)/2 of the speed; the solver's tolerance is 1e-6 of it. Balls that are slower
    # than a blow that bounces, 2 cm/s, may go on together.
    assert solver.bodies.velocity[-1, 0] == pytest.approx((0.5 * (1.0 + restitution)) ** 4, rel=1e-5)
    assert solver.bodies.velocity[:, 0].sum() == pytest.approx(1.0, abs=1e-12)
    assert energy(solver) <= start * (1.0 + 1e-9)
    if restitution == 1.0:
        assert energy(solver) == pytest.approx(start, rel=1e-5)


def test_two_balls_that_hit_a_row_send_two_off():
    radius, gap = 0.05, 2e-4
    row = [body(f"b{k}", ball(radius), (k * 0.1, 0, 1), restitution=1.0) for k in range(3)]
    hits = [
        body(f"h{k}", ball(radius), (-0.13 - k * (0.1 + gap), 0, 1), velocity=(1, 0, 0), restitution=1.0)
        for k in range(2)
    ]
    solver = in_space(*hits, *row)
    advance(solver, 0.3)
    # In the order of their places; the solver's tolerance.
    np.testing.assert_allclose(solver.bodies.velocity[[1, 0, 2, 3, 4], 0], [0, 0, 0, 1, 1], atol=1e-5)


def brick_wall(columns: int, rows: int) -> RigidSolver:
    """Bricks in running bond, without mortar; every other row begins and ends with half a brick."""
    length, width, height = 0.24, 0.115, 0.071
    bricks = []
    for row in range(rows):
        edges = np.arange(columns + 1.0) if row % 2 == 0 else np.array([0.0, *np.arange(0.5, columns), columns])
        for column, (left, right) in enumerate(itertools.pairwise(edges)):
            shape = {"type": "box", "size": ((right - left) * length, width, height)}
            place = (0.5 * (left + right - columns) * length, 0.0, (row + 0.5) * height)
            bricks.append(body(f"brick{row}_{column}", shape, place, density=1800.0, friction=0.6))
    return in_room(*bricks)


def run(solver: RigidSolver, duration_s: float) -> list[float]:
    """The rms speed of the bodies after each frame [m/s]."""
    solver.has_own_steps = True
    speeds = []
    for frame in range(round(60 * duration_s)):
        solver.begin_frame(frame / 60)
        for _ in range(9):
            solver.substep(1 / 540)
        speeds.append(math.sqrt(np.square(solver.bodies.velocity).sum(axis=1).mean()))
    return speeds


def stands(wall: RigidSolver, duration_s: float) -> list[float]:
    """Speeds as of `run`, of a wall that does not move and sleeps at the end."""
    start = wall.bodies.position.copy()
    speeds = run(wall, duration_s)
    assert max(speeds) < 1e-3
    assert np.linalg.norm(wall.bodies.position - start, axis=1).max() < 1e-4
    assert wall.bodies.is_asleep.all()
    return speeds


def test_a_wall_of_bricks_stands_and_does_not_tremble():
    assert stands(brick_wall(4, 6), SLEEP_TIME_S + 0.4)[-1] == 0.0


def test_a_wall_in_colours_stands_as_well(monkeypatch):
    """As GPUs solve contacts."""
    monkeypatch.setattr("sim.rigid.contact_response.runs_on_gpu", lambda: True)
    solver = brick_wall(3, 4)
    stands(solver, SLEEP_TIME_S + 0.1)
    assert solver.diagnostics()["not_converged"] == 0.0


def test_a_high_wall_of_bricks_does_not_tremble_either():
    """Of 199, whose solves end before they have converged: what is left must not add up, nor contacts take turns."""
    solver = brick_wall(10, 19)
    assert max(run(solver, 0.1)) < 1e-3


def pyramid(layers: int) -> RigidSolver:
    """Boxes in square layers, a millimetre apart, and a heavy block that flies into their upper half."""
    edge, pitch = 0.1, 0.101
    boxes = [
        body(
            f"box{layer}_{row}_{column}",
            cube(edge),
            (pitch * (row - 0.5 * (size - 1)), pitch * (column - 0.5 * (size - 1)), (layer + 0.5) * edge),
            friction=0.5,
        )
        for layer, size in enumerate(range(layers, 0, -1))
        for row in range(size)
        for column in range(size)
    ]
    away = 0.5 * pitch * layers
    place = (-away - 0.3, 0.0, 0.5 * layers * edge + 0.15)
    hit = body("hit", cube(0.25), place, velocity=(6.0, 0, 0), density=3000.0, friction=0.5)
    hall = DomainParameters(min=(-4.0 * away, -3.0 * away, 0.0), max=(5.0 * away, 3.0 * away, 4.0))
    return in_room(*boxes, hit, domain=hall)


def test_a_pyramid_falls_when_it_is_hit_and_comes_to_rest():
    solver = pyramid(4)
    start = solver.bodies.position.copy()
    run(solver, 0.03)
    boxes = slice(0, -1)
    assert np.linalg.norm(solver.bodies.position - start, axis=1)[boxes].max() < 1e-4  # it stands until then
    run(solver, 3.0)
    moved = np.linalg.norm(solver.bodies.position - start, axis=1)[boxes]
    assert np.count_nonzero(moved > 0.2) >= 5  # those of the upper two layers
    assert start[boxes, 2].mean() - solver.bodies.position[boxes, 2].mean() > 0.02
    assert solver.bodies.is_asleep.all()
    solver.bodies.wake(np.ones(len(start), dtype=bool))
    run(solver, 0.05)
    assert solver.diagnostics()["max_penetration"] < 1e-4  # a thousandth of an edge
    assert solver.bodies.position[boxes, 2].min() > 0.049


@pytest.mark.parametrize(
    ("edge", "density", "gap", "slowest"),
    [(0.25, 3000.0, 1e-3, 5.0), (0.1, 3000.0, 4e-3, 2.5), (0.1, 500.0, 1e-3, 0.7)],
)
def test_what_is_hit_does_not_enter_the_next_of_a_row(edge, density, gap, slowest):
    """Within a step it gets farther than to the next box, which it would not have met by its own speed."""
    row = [body(f"box{k}", cube(0.1), ((0.1 + gap) * k, 0.0, 0.05), friction=0.5) for k in range(6)]
    place = (-0.075 - 0.5 * edge, 0.0, 0.5 * edge)
    hit = body("hit", cube(edge), place, velocity=(6.0, 0.0, 0.0), density=density, friction=0.5)
    solver = in_room(*row, hit)
    solver.has_own_steps = True
    solver.begin_frame(0.0)
    for _ in range(12):
        solver.substep(1 / 540)
    assert solver.bodies.velocity[:, 0].min() > slowest
    assert solver.diagnostics()["max_penetration"] < 1e-4


def test_hulls_in_a_bowl_come_to_rest_without_sinking_in(tmp_path):
    path = tmp_path / "hull.ply"
    points = np.random.default_rng(3).normal(size=(40, 3))
    points *= np.array([0.12, 0.1, 0.08]) / np.linalg.norm(points, axis=1, keepdims=True)
    trimesh.convex.convex_hull(points).export(path)
    angles = np.linspace(0.0, 1.4, 24)
    arc = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    outline = np.concatenate([0.4 * arc, 0.35 * arc[::-1]])
    bowl = body("bowl", {"type": "revolved", "profile": outline.tolist()}, (0, 0, 0.5), kind="static")
    hulls = [
        body(
            f"hull{k}",
            {"type": "mesh", "file": str(path)},
            (0.12 * math.cos(2.1 * k), 0.12 * math.sin(2.1 * k), 0.6 + 0.15 * k),
            rotation_deg=(70 * k, 40 * k, 0),
        )
        for k in range(6)
    ]
    solver = in_room(*hulls, obstacles=[bowl])
    run(solver, 2.5)
    assert solver.bodies.is_asleep.all()
    solver.bodies.wake(np.ones(6, dtype=bool))
    run(solver, 0.1)
    assert 0.0 < solver.diagnostics()["max_penetration"] < 1e-4
    assert np.all(np.linalg.norm(solver.bodies.position[:, :2], axis=1) < 0.35)
    assert np.all(solver.bodies.position[:, 2] > 0.0)
