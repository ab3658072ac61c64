"""Contacts of bodies that are near: distances, normals, and which of them are kept."""

import numpy as np
import pytest
import trimesh
from rigid_scenes import ball, body, cube, in_room, in_space
from scipy.optimize import nnls

from sim.core.domain import DomainParameters
from sim.rigid.broad_phase import overlapping_on_host, overlapping_pairs
from sim.rigid.collision import CollisionDetector
from sim.rigid.contacts import Contacts
from sim.rigid.polytopes import polytope_of
from sim.rigid.solver import RigidSolver

PROBE = 0.01


def contacts_of(solver: RigidSolver, within: float, *, after: RigidSolver | None = None) -> Contacts:
    """All contacts with gaps up to some length [m], at least, found anew after those where the bodies were before."""
    count = len(solver.all_geometries)
    moves = np.arange(count) < len(solver.bodies)
    detector = CollisionDetector(solver.all_geometries, solver.walls, len(solver.bodies))
    if after is not None:
        detector.find(after.poses(), np.full(count + 1, within), moves)
        detector.follow(np.full(count + 1, 1.0))
    detector.find(solver.poses(), np.full(count + 1, within), moves)
    return detector.contacts()


@pytest.mark.parametrize(
    "shape",
    [
        ball(0.2),
        {"type": "box", "size": (0.3, 0.4, 0.5)},
        {"type": "cylinder", "radius": 0.1, "height": 0.3},
        {"type": "capsule", "radius": 0.1, "height": 0.3},
        {"type": "torus", "major_radius": 0.3, "minor_radius": 0.1},
        {"type": "cone", "radius": 0.2, "height": 0.3},
        {"type": "revolved", "profile": [[0.0, 0.0], [0.2, 0.0], [0.3, 0.3], [0.25, 0.3], [0.15, 0.05], [0.0, 0.05]]},
    ],
    ids=lambda shape: shape["type"],
)
def test_distances_and_normals_of_contacts_are_those_of_the_shape(shape):
    random = np.random.default_rng(2)
    places = random.uniform(-0.5, 0.5, (60, 3))
    probes = [body(f"p{k}", ball(PROBE), tuple(place), kind="kinematic") for k, place in enumerate(places)]
    solver = in_space(*probes, body("shape", shape, (0.0, 0.0, 0.0), rotation_deg=(20, 40, 60)))
    found = contacts_of(solver, 1.0)
    mine = found.second == 60
    assert np.count_nonzero(mine) == 60  # each by its one ball
    geometry, poses = solver.solids[60], solver.poses()
    centres = (places - poses.position[60]) @ poses.rotation[60]
    np.testing.assert_allclose(found.gap[mine] + PROBE, geometry.signed_distance(centres), atol=1e-12)
    # Along the normal the distance grows by as much. Differences leave 1e-7 of a length.
    moved = centres + 1e-4 * found.normal[mine] @ poses.rotation[60]
    np.testing.assert_allclose(geometry.signed_distance(moved), found.gap[mine] + PROBE + 1e-4, atol=2e-7)


def test_distances_of_a_mesh_are_read_from_a_grid_that_agrees_with_its_exact_distance(tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=3, radius=0.1).export(path)
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= 0.105 / np.linalg.norm(points, axis=1, keepdims=True)
    probes = [body(f"p{k}", ball(0.001), tuple(point), kind="kinematic") for k, point in enumerate(points)]
    solver = in_space(body("mesh", {"type": "mesh", "file": str(path)}, (0, 0, 0)), *probes)
    found = contacts_of(solver, 0.005)
    mine = found.first == 0
    assert np.count_nonzero(mine) == 200
    cell = 0.2 / 48
    # Trilinear interpolation: cell²/(4 R) for the curvature, and at the facets' edges, where the distance has a kink of
    # 8 degrees, half a cell's diagonal times the slope of half of that.
    tolerance = cell**2 / 0.4 + 0.87 * cell * np.sin(np.deg2rad(4.0))
    exact = solver.solids[0].signed_distance(points - solver.bodies.position[0])
    np.testing.assert_allclose(found.gap[mine] + 0.001, exact, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)
    assert np.max(np.einsum("ij,ij->i", found.normal[mine], points) / 0.105) < -np.cos(np.deg2rad(8.0))  # facets: 7°


@pytest.mark.parametrize("angle_deg", np.linspace(0.0, 90.0, 12))
def test_a_box_on_the_floor_is_held_at_its_corners_however_it_is_turned(angle_deg):
    solver = in_room(body("box", cube(0.2), (0.1, 0.2, 0.1), rotation_deg=(0, 0, angle_deg)))
    found = contacts_of(solver, 0.001)
    in_box = np.abs((found.point - solver.bodies.position[0]) @ solver.bodies.rotation()[0])
    assert np.count_nonzero(np.all(in_box[:, :2] > 0.095, axis=1)) == 4
    assert len(found) <= 9


def test_a_table_has_contacts_at_its_legs_and_not_only_at_its_rim_above_them(tmp_path):
    path = tmp_path / "table.ply"
    legs = [(0.6, 0.0), (-0.3, 0.5), (-0.3, -0.5)]
    parts = [trimesh.creation.box((2.0, 2.0, 0.2), trimesh.transformations.translation_matrix((0, 0, 0.109)))]
    for x, y in legs:
        place = trimesh.transformations.translation_matrix((x, y, 0.05))
        parts.append(trimesh.creation.box((0.1, 0.1, 0.1), place))
    trimesh.util.concatenate(parts).export(path)
    solver = in_room(body("table", {"type": "mesh", "file": str(path)}))
    solver.bodies.position[0, 2] -= solver.poses().position[0, 2] + solver.solids[0].bounds[0, 2] + 0.001
    found = contacts_of(solver, 0.01)
    for x, y in legs:
        assert np.min(np.hypot(found.point[:, 0] - x, found.point[:, 1] - y)) < 0.1


def test_contacts_of_the_last_step_are_preferred_among_equals():
    """A cylinder that turns on the spot stands on one point of its rim as well as on the next."""
    can = {"type": "cylinder", "radius": 0.1, "height": 0.1}
    upright = in_room(body("can", can, (0.0, 0.0, 0.05)))
    turned = in_room(body("can", can, (0.0, 0.0, 0.05), rotation_deg=(0, 0, 2.0)))
    before, anew, kept = (
        found.keys()
        for found in (
            contacts_of(upright, 0.001),
            contacts_of(turned, 0.001),
            contacts_of(turned, 0.001, after=upright),
        )
    )
    assert len(np.intersect1d(anew, before)) < len(np.intersect1d(kept, before))


def test_a_body_in_a_corner_of_the_domain_has_contacts_with_each_wall():
    tank = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0), open_faces=("y-",))
    solver = in_room(body("box", cube(0.2), (0.1, 0.1, 0.1)), domain=tank)
    found = contacts_of(solver, 0.001)
    assert {tuple(normal) for normal in found.normal.tolist()} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert len(np.unique(found.keys())) == len(found) >= 8


@pytest.mark.parametrize("overlapping", [overlapping_pairs, overlapping_on_host])
@pytest.mark.parametrize("floor", [False, True])
def test_the_broad_phase_finds_what_comparing_all_pairs_finds(floor, overlapping):
    random = np.random.default_rng(4)
    centre, half = random.uniform(0, 1, (300, 3)), random.uniform(0.005, 0.1, (300, 3))
    if floor:  # one that is far larger
        centre[7], half[7] = (0.5, 0.5, -1.0), (5.0, 5.0, 1.1)
    is_active = random.uniform(size=300) < 0.6
    first, second = overlapping(centre - half, centre + half, is_active)
    one, two = np.triu_indices(300, 1)
    overlap = np.all(np.abs(centre[one] - centre[two]) <= half[one] + half[two], axis=1)
    wanted = overlap & (is_active[one] | is_active[two])
    np.testing.assert_array_equal(np.stack([first, second]), np.stack([one[wanted], two[wanted]]))


def test_boxes_and_convex_meshes_are_as_far_apart_as_their_nearest_points(tmp_path):
    """Beside a least-squares solution for the weights of both bodies' vertices, for pairs turned at random."""
    random, path = np.random.default_rng(0), tmp_path / "stone.ply"
    points = np.random.default_rng(3).normal(size=(40, 3))
    trimesh.convex.convex_hull(points * [0.05] / np.linalg.norm(points, axis=1, keepdims=True)).export(path)
    shapes = [cube(0.1), {"type": "mesh", "file": str(path)}]
    overlapping = 0
    for trial in range(60):
        apart, turns = random.normal(size=3), random.uniform(-180, 180, (2, 3))
        apart *= random.uniform(0.07, 0.13) / np.linalg.norm(apart)
        kinds = shapes[trial % 2], shapes[trial // 2 % 2]
        places = (np.zeros(3), apart)
        solver = in_space(
            *(
                body(f"b{k}", kinds[k], tuple(places[k]), rotation_deg=tuple(turns[k]), kind="kinematic")
                for k in range(2)
            )
        )
        found, poses = contacts_of(solver, 0.1), solver.poses()
        polytopes = [polytope_of(geometry) for geometry in solver.solids]
        one, two = (
            poses.position[k] + polytopes[k].vertices @ poses.rotation[k].T
            for k in range(2)
            if polytopes[k] is not None
        )
        sums = np.zeros((2, len(one) + len(two)))
        sums[0, : len(one)] = sums[1, len(one) :] = 1e3
        weights, _ = nnls(np.vstack([np.hstack([one.T, -two.T]), sums]), np.array([0.0, 0.0, 0.0, 1e3, 1e3]))
        distance = np.linalg.norm(weights[: len(one)] @ one - weights[len(one) :] @ two)
        rounded = polytopes[0].radius + polytopes[1].radius
        if distance < 1e-6:
            overlapping += 1
            assert found.gap.min() < -rounded
        else:
            assert found.gap.min() == pytest.approx(distance - rounded, abs=1e-6)
    assert 0 < overlapping < 60
