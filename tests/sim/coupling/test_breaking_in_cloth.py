"""Bodies that break, and cloth: one body as long as they hold, and pieces that it catches after that."""

import numpy as np
import pytest
from cloth_scenes import SOFT, WEIGHTLESS, rectangle
from contact_scenes import SPACE, cloth_of, contacts_of, momenta, rigid_of, world_of

from sim.core.world import World

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SHEET = {**SOFT, "shape": rectangle((0.3, 0.3), (11, 11)), "thickness": 2e-3, "self_collision": False}
HOLDS, BREAKS = 1.0e9, 300.0  # strengths [Pa]


def hits_a_sheet(strength: float | None, density: float = 300.0) -> World:
    """A box, whole or of six pieces, that turns and hits a free sheet in space."""
    box = {
        "kind": "dynamic",
        "density": density,
        "shape": {"type": "box", "size": (0.08, 0.1, 0.06)},
        "position": (0.03, 0.01, 0.06),
        "rotation_deg": (10.0, 20.0, 0.0),
        "velocity": (0.3, 0.0, -3.0),
        "angular_velocity": (0.0, 20.0, 5.0),
    }
    if strength is not None:
        box["breaks"] = {"strength": strength, "pieces": 6}
    return world_of(SHEET, bodies=[box], domain=SPACE, gravity=WEIGHTLESS)


def test_cloth_moves_what_is_glued_as_it_moves_the_whole():
    whole, glued = hits_a_sheet(None), hits_a_sheet(HOLDS)
    before = rigid_of(whole).bodies.velocity[0].copy(), rigid_of(whole).bodies.angular_velocity[0].copy()
    for world in (whole, glued):
        for _ in range(2):
            world.advance_frame()
    bodies, movers = rigid_of(whole).bodies, rigid_of(glued).glue.movers
    slowed, turned = (np.linalg.norm(now[0] - then) for now, then in zip((bodies.velocity, bodies.angular_velocity),
                                                                         before, strict=True))  # fmt: skip
    assert slowed > 0.2
    # Pieces meet the sheet by their grids, the whole by a formula: edges are rounded by a millimetre.
    assert np.linalg.norm(movers.velocity[0] - bodies.velocity[0]) < 0.06 * slowed
    assert np.linalg.norm(movers.angular_velocity[0] - bodies.angular_velocity[0]) < 0.06 * turned


def test_a_body_that_breaks_on_a_sheet_keeps_momentum_and_a_restart_goes_on_with_the_same_bits():
    world = hits_a_sheet(BREAKS, density=1000.0)
    linear, angular = momenta(world)
    kept, broken = [world.checkpoint()], [0]
    for _ in range(3):
        world.advance_frame()
        kept.append(world.checkpoint())
        broken.append(int(rigid_of(world).glue.is_broken.sum()))
    assert broken[1] > 0
    assert np.ptp(rigid_of(world).bodies.velocity[:, 2]) > 0.2  # what the sheet holds, and what flies past it
    for frame in (0, 1):
        again = hits_a_sheet(BREAKS, density=1000.0)
        again.restore(frame, kept[frame])
        while again.frame < world.frame:
            again.advance_frame()
        found = again.checkpoint()
        for name, array in world.checkpoint().items():
            np.testing.assert_array_equal(array, found[name], err_msg=name)
    linear_after, angular_after = momenta(world)
    assert np.linalg.norm(linear_after - linear) < 1e-6 * np.linalg.norm(linear)
    assert np.linalg.norm(angular_after - angular) < 1e-5 * np.linalg.norm(angular)


def test_what_a_piece_gets_moves_all_that_it_is_glued_to_within_the_step():
    """Pieces of one body answer to contacts together: the sum of what they got changes the whole's motion."""
    world = hits_a_sheet(HOLDS)
    contacts, rigid = contacts_of(cloth_of(world)), rigid_of(world)
    glue, resolve, seen = rigid.glue, contacts.resolve, []

    def watched(dt, *arguments):
        outcome = resolve(dt, *arguments)
        pushed, unit = contacts.rigid.pushed, contacts._impulse_unit
        given = unit * pushed.impulse.to_numpy().reshape(-1, 6)[: len(rigid.bodies)]
        motion = contacts.rigid.colliding.motion.to_numpy().reshape(-1, 2, 3)[: len(rigid.bodies)].astype(np.float64)
        arm = rigid.bodies.position - glue.movers.position[0]
        torque = (given[:, 3:] + np.cross(arm, given[:, :3])).sum(axis=0)
        turn = dt * glue.movers.angular_velocity[0] + glue.movers.inverse_inertia()[0] @ torque
        shift = dt * glue.movers.velocity[0] + glue.movers.inverse_mass[0] * given[:, :3].sum(axis=0)
        off = np.abs(motion[:, 0] - (shift + np.cross(turn, arm))).max(), np.abs(motion[:, 1] - turn).max()
        seen.append((np.count_nonzero(given.any(axis=1)), *off, dt))
        return outcome

    contacts.resolve = watched
    for _ in range(2):
        world.advance_frame()
    touched, shifts, turns, steps = np.array(seen).T
    assert touched.max() >= 2  # of six pieces
    assert (shifts / steps).max() < 1e-4  # [m/s], of 3
    assert (turns / steps).max() < 1e-3  # [rad/s], of 20
