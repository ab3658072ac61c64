"""Blocks of soft matter: many of one table, and the dye that their particles carry."""

import numpy as np
import pytest
from pydantic import ValidationError
from thread_counts import digest_of

from sim.build import build_world
from sim.fluid.parameters import FluidParameters
from sim.scene import SceneParameters
from sim.shapes.extent import depth_inside
from sim.shapes.filled_parameters import BlockParameters
from sim.soft.parameters import SoftParameters

BALL = {"shape": {"type": "sphere", "radius": 0.03}}
ROOM = {"type": "box", "size": (0.3, 0.3, 0.2)}
OPENING = {
    "shape": {"type": "rectangle", "size": (0.03, 0.03)},
    "position": (0.0, 0.0, 0.18),
    "direction": (0.0, 0.0, -1.0),
    "speed": 0.5,
    "total_volume": 4.5e-5,
    "dye": 0.25,
}


def snow(*block, **keys):
    return SoftParameters(name="snow", material="snow", cell_size=0.01, block=block, **keys)


def world_of(*bodies):
    domain = {"min": (-0.2, -0.2, 0.0), "max": (0.2, 0.2, 0.3)}
    return build_world(SceneParameters.model_validate({"domain": domain, "soft": bodies}), frames_per_second=60)


def test_a_dozen_scattered_balls_are_of_several_sizes_clear_of_each_other_and_the_same_again():
    table = BALL | {"count": 12, "scatter": {"shape": ROOM, "gap": 0.01}, "scales": (0.5, 1.0), "velocity": (1, 0, 0)}
    balls, again, other = (snow(table | {"seed": seed}).block for seed in (4, 4, 5))
    assert balls == again != other
    assert {ball.velocity for ball in balls} == {(1.0, 0.0, 0.0)}
    place, radius = np.array([ball.position for ball in balls]), np.array([0.03 * ball.scale for ball in balls])
    assert len(set(radius)) > 3
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1) - radius[:, None] - radius[None]
    assert apart[np.triu_indices(12, 1)].min() >= 0.01 - 1e-8
    room = BlockParameters.model_validate({"shape": ROOM}).shape
    assert all(depth_inside(room, at) >= size - 1e-8 for at, size in zip(place, radius, strict=True))
    # Blocks of another body, and another table of this one, lie elsewhere.
    both = SoftParameters(name="ice", material="snow", block=(table, table)).block
    assert len({block.position for block in (*balls, *both)}) == 36


@pytest.mark.usefixtures("taichi_cpu")
def test_a_lattice_gives_the_bits_of_a_table_for_each_of_its_blocks():
    jittered = {"count": (2, 1, 2), "spacing": 0.09, "jitter": {"position": (0.01, 0.0, 0.0)}}
    group = snow(BALL | jittered | {"position": (-0.05, 0.0, 0.05)})
    tables = snow(*({**BALL, "position": block.position} for block in group.block))
    assert [block.table for block in group.block] == [0] * 4
    assert group.model_dump() == tables.model_dump()
    worlds = [world_of(body) for body in (group, tables)]
    for world in worlds:
        world.advance_frame()
    assert digest_of(worlds[0].checkpoint()) == digest_of(worlds[1].checkpoint())


def test_blocks_of_fluids_can_be_many_too():
    water = FluidParameters(name="water", block=(BALL | {"count": 3, "spacing": 0.1}, BALL | {"position": (0, 1, 0)}))
    assert [(*block.position, block.table) for block in water.block][1:] == [
        (0.1, 0, 0, 0),
        (0.2, 0, 0, 0),
        (0, 1, 0, 1),
    ]


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ({"count": 40, "scatter": {"shape": ROOM}, "scale": 2.0}, "has room for .* of 40 bodies"),
        ({"count": 3}, "give one of spacing, along, scatter"),
        ({"seed": 3}, "add count, or remove it"),
        ({"dye": 0.5}, "has a dye of 0.5 everywhere, and nothing to mix with"),
        ({"dye": -1.0}, "greater than or equal to 0"),
    ],
)
def test_blocks_without_room_a_place_or_a_meaning_are_refused(keys, rule):
    with pytest.raises(ValidationError, match=rule):
        snow(BALL | keys)


@pytest.mark.usefixtures("taichi_cpu")
def test_particles_keep_the_dye_of_their_block_or_emitter_as_they_mix_and_after_a_restart():
    """A dyed ball falls onto one without, as more is poured: each particle has what it began with."""
    balls = BALL | {"position": (0.0, 0.0, 0.03)}, BALL | {"position": (0.01, 0.0, 0.095), "dye": 1.0}
    bodies = (
        snow(*balls, emitter=(OPENING,)),
        SoftParameters(name="jelly", material="jelly", cell_size=0.01, block=(BALL | {"position": (0.15, 0.15, 0.1)},)),
    )
    world, resumed = world_of(*bodies), world_of(*bodies)
    first = world.snapshots()["snow"].arrays
    lower, upper = first["position"][:, 2] < 0.06, first["position"][:, 2] > 0.06
    assert (first["dye"][lower] == 0.0).all() and (first["dye"][upper] == 1.0).all() and upper.any()
    for _ in range(6):
        world.advance_frame()
    after = world.snapshots()["snow"].arrays
    began = dict(zip(first["particle_id"].tolist(), first["dye"].tolist(), strict=True))
    poured = [began.get(each) is None for each in after["particle_id"].tolist()]
    assert sum(poured) > 50
    assert after["dye"].tolist() == [began.get(each, 0.25) for each in after["particle_id"].tolist()]
    assert "dye" not in world.snapshots()["jelly"].arrays
    resumed.restore(6, world.checkpoint())
    np.testing.assert_array_equal(resumed.snapshots()["snow"].arrays["dye"], after["dye"])
