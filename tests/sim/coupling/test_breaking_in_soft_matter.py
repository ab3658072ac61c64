"""Bodies that break, and soft matter: one body as long as they hold, and pieces that it holds back after that."""

from typing import Any

import numpy as np
import pytest
import taichi as ti
from test_soft_rigid import JELLY, linear_and_angular, world_of

from sim.core.arrays import Integers, Vectors, on_device
from sim.core.launch import kernel
from sim.coupling.soft_rigid import SoftRigidCoupling
from sim.soft.blocks import NODES
from sim.soft.contact import BodyContacts, Touching, body_at, outward

pytestmark = pytest.mark.usefixtures("taichi_cpu")

HOLDS, BREAKS = 1.0e9, 2.0e3  # strengths [Pa]
MOST_FRAMES = 10  # until the box breaks


def hits_jelly(strength: float | None, **keys: Any) -> Any:
    """A box, whole or of six pieces, that turns and hits a block of jelly in space."""
    box = {"name": "box", "kind": "dynamic", "density": 300.0, "shape": {"type": "box", "size": (0.08, 0.1, 0.06)}}
    box |= {"position": (-0.25, 0.05, 0.0), "rotation_deg": (10.0, 20.0, 0.0)}
    box |= {"velocity": (3.0, 0.0, 0.0), "angular_velocity": (0.0, 20.0, 10.0)}
    if strength is not None:
        box["breaks"] = {"strength": strength, "pieces": 6}
    return world_of(soft=[JELLY | keys], rigid=[box])


def advance(world: Any, frames: int) -> None:
    for _ in range(frames):
        world.advance_frame()


@pytest.mark.parametrize("sticks_to", [[], ["box"]])
def test_soft_matter_moves_what_is_glued_as_it_moves_the_whole(sticks_to):
    whole, glued = (hits_jelly(strength, sticks_to=sticks_to) for strength in (None, HOLDS))
    for world in (whole, glued):
        advance(world, 5)
    bodies, movers = whole.solvers["rigid"].bodies, glued.solvers["rigid"].glue.movers
    assert bodies.velocity[0, 0] < 1.5
    # The surface is that of the whole: only rounding differs, and which node is inside by a hair.
    np.testing.assert_allclose(movers.velocity[0], bodies.velocity[0], atol=1e-4)
    np.testing.assert_allclose(movers.angular_velocity[0], bodies.angular_velocity[0], atol=5e-3)


def test_a_body_that_breaks_on_jelly_keeps_momentum_and_a_restart_goes_on_with_the_same_bits():
    world = hits_jelly(BREAKS)
    linear, angular = linear_and_angular(world)
    kept = [world.checkpoint()]
    glue = world.solvers["rigid"].glue
    for _ in range(MOST_FRAMES):
        world.advance_frame()
        kept.append(world.checkpoint())
        if glue.is_broken.any():
            break
    assert glue.is_broken.any()
    broke = world.frame
    advance(world, 2)
    for frame in (broke - 1, broke):
        again = hits_jelly(BREAKS)
        again.restore(frame, kept[frame])
        advance(again, world.frame - frame)
        found = again.checkpoint()
        for name, array in world.checkpoint().items():
            np.testing.assert_array_equal(array, found[name], err_msg=name)
    assert len(np.unique(glue.leader)) > 1
    now = linear_and_angular(world)
    np.testing.assert_allclose(now[0], linear, atol=1e-6 * np.linalg.norm(linear))
    np.testing.assert_allclose(now[1], angular, atol=1e-5 * np.linalg.norm(angular))


@pytest.mark.parametrize("falls_off", [False, True])
def test_pieces_that_hold_take_room_from_sand_as_the_one_solid_that_they_are(falls_off):
    """Three cubes in a row, against the body of those that are left which cannot break."""
    cubes = [{"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}, "position": (0.1 * n, 0.0, 0.0)} for n in range(3)]
    row, left = (
        {"name": "row", "kind": "dynamic", "density": 300.0, "shape": {"type": "compound", "part": cubes[:count]}}
        | {"position": (-0.09, 0.0, 1.0)}  # seams are at nodes
        for count in (3, 2 if falls_off else 3)
    )
    row["breaks"] = {"strength": HOLDS}
    sand = {**JELLY, "material": "sand", "cell_size": 0.02, "block": [{"shape": {"type": "box", "size": (0.4,) * 3}}]}
    found = []
    for body in (row, left):
        world = world_of(soft=[sand], rigid=[body])
        soft, rigid = world.solvers["soft"], world.solvers["rigid"]
        rigid.bodies.position[:, 2] -= 1.0  # sand is in all of it then
        if body is row:
            rigid.glue.movers.position[:, 2] -= 1.0
            if falls_off:
                rigid.glue.split(np.flatnonzero((rigid.glue.faces.first == 2) | (rigid.glue.faces.second == 2)))
                rigid.bodies.position[2] += (0.0, 0.0, 10.0)
        SoftRigidCoupling(soft, rigid, soft.contacts)
        soft.substep(1e-6)
        soft._find_room()
        found += [array.to_numpy()[: soft._grid.count * NODES] for array in (soft._nodes.mass, soft._nodes.room)]
    both = (found[0] > 0.0) & (found[2] > 0.0)
    glued, whole = found[1][both] / 0.02**3, found[3][both] / 0.02**3
    assert whole.max() == pytest.approx(1.0)
    assert np.count_nonzero(whole < 0.2) > 100
    # The grids of pieces are others than that of two cubes: by a tenth of a cell of sand beside edges.
    np.testing.assert_allclose(glued, whole, atol=0.15 if falls_off else 1e-4)


@kernel
def look(points: Vectors, count: ti.i32, touching: Touching, inside: Integers, normals: Vectors):
    for i in range(count):
        inside[i] = body_at(points[i], touching, 0.02)
        if inside[i] >= 0:
            normals[i] = outward(points[i], inside[i], touching)


def looked_at(contacts: BodyContacts, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inside, normals = ti.ndarray(ti.i32, len(points)), ti.Vector.ndarray(3, ti.f32, len(points))
    look(on_device(points.astype(np.float32)), len(points), contacts._touching, inside, normals)
    return inside.to_numpy(), normals.to_numpy()


def test_nodes_are_led_out_of_what_holds_and_not_into_its_seams():
    """Of a row of three cubes the last breaks off."""
    cubes = [{"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}, "position": (0.1 * n, 0.0, 0.0)} for n in range(3)]
    row = {"name": "row", "kind": "dynamic", "density": 300.0, "shape": {"type": "compound", "part": cubes}}
    world = world_of(soft=[JELLY], rigid=[row | {"position": (-0.2, 0.0, 0.4), "breaks": {"strength": HOLDS}}])
    soft, rigid = world.solvers["soft"], world.solvers["rigid"]
    points = np.array([[-0.15, 0.0, 0.43], [-0.148, 0.0, 0.43], [-0.052, 0.0, 0.43], [-0.052, 0.03, 0.4]])
    inside, normals = looked_at(soft.contacts, points)
    assert inside.min() >= 0  # on a seam, too
    np.testing.assert_allclose(normals[:3], np.tile((0.0, 0.0, 1.0), (3, 1)), atol=1e-3)
    np.testing.assert_allclose(normals[3], (0.0, 1.0, 0.0), atol=1e-3)

    glue = rigid.glue
    glue.split(np.flatnonzero((glue.faces.first == 2) | (glue.faces.second == 2)))
    SoftRigidCoupling(soft, rigid, soft.contacts)
    inside, normals = looked_at(soft.contacts, points)
    assert (inside[2:] == 1).all()
    np.testing.assert_allclose(normals[:2], np.tile((0.0, 0.0, 1.0), (2, 1)), atol=1e-3)
    np.testing.assert_allclose(normals[2:], np.tile((1.0, 0.0, 0.0), (2, 1)), atol=1e-3)  # into the gap
