"""Coupled steps give the same bits whatever the number of threads."""

import pytest
from cloth_tanks import EDGES, ClothTank, rectangle
from coupled_tanks import Tank
from test_breaking_in_cloth import BREAKS as BREAKS_ON_A_SHEET
from test_breaking_in_cloth import hits_a_sheet
from test_breaking_in_soft_matter import BREAKS as BREAKS_ON_JELLY
from test_breaking_in_soft_matter import hits_jelly
from thread_counts import digest_of, result_on_any_threads

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.core.world import World
from sim.rigid.solver import RigidSolver
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")


def ball_in_water(solver: str) -> tuple[str, float]:
    ball = {"kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 0.09}}
    tank = Tank(
        [{**ball, "position": (0.15, 0.18, 0.28), "velocity": (0.0, 0.0, -1.0)}],
        domain=DomainParameters(min=(0.0, 0.0, 0.0), max=(0.36, 0.36, 0.6)),
        water=((0.0, 0.0, 0.0), (0.36, 0.36, 0.2)),
        solver=solver,
        wall_friction=1.0,
    )
    for _ in range(15):
        tank.step()
    return digest_of(tank.world.checkpoint()), float(abs(tank.coupling.force).max())


def dye_poured_on_a_ball() -> tuple[str, float]:
    """Returns the dye that has got into the water at the ball in place of a push."""
    ball = {"name": "ball", "kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 0.025}}
    pool = {"shape": {"type": "box", "size": (0.2, 0.1, 0.06)}, "position": (0.1, 0.05, 0.03), "dye": 0.25}
    spout = {"shape": {"type": "disc", "radius": 0.02}, "position": (0.1, 0.05, 0.2), "direction": (0.0, 0.0, -1.0)}
    water = {"name": "water", "solver": "dfsph", "particle_radius": 0.008, "wall_friction": 1.0, "block": [pool]}
    scene = {
        "domain": {"min": (0.0, 0.0, 0.0), "max": (0.2, 0.1, 0.3), "open_faces": ()},
        "rigid": [{**ball, "position": (0.1, 0.05, 0.09)}],
        "fluid": [{**water, "dye_diffusivity": 1.0e-4, "emitter": [{**spout, "speed": 0.5, "dye": 1.0}]}],
    }
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=30.0)
    for _ in range(5):
        world.advance_frame()
    dye = world.snapshots()["water"].arrays["dye"]
    return digest_of(world.checkpoint()), float(dye.max() - dye.min())


def water_on_cloth() -> tuple[str, float]:
    tank = ClothTank(
        cloth={"shape": rectangle(0.16, 9), "position": (0.0, 0.0, 0.1), "mass_per_area": 0.2, "pin": EDGES},
        water=((-0.08, -0.08, 0.1), (0.08, 0.08, 0.18)),
        solver="dfsph",
        wall_friction=1.0,
        domain={"min": (-0.08, -0.08, 0.0), "max": (0.08, 0.08, 0.3)},
    )
    tank.run(0.02)
    return digest_of(tank.world.checkpoint()), float(abs(tank.coupling.impulse()).max())


def broken(world: World, frames: int) -> tuple[str, float]:
    """Returns how many faces have broken in place of a push."""
    for _ in range(frames):
        world.advance_frame()
    rigid = world.solvers["rigid"]
    assert isinstance(rigid, RigidSolver)
    assert rigid.glue is not None
    return digest_of(world.checkpoint()), float(rigid.glue.is_broken.sum())


def coupled_digests() -> list[tuple[str, float]]:
    return [ball_in_water("wcsph"), ball_in_water("pcisph"), dye_poured_on_a_ball(), water_on_cloth()]


def broken_digests() -> list[tuple[str, float]]:
    return [broken(hits_a_sheet(BREAKS_ON_A_SHEET, density=1000.0), 2), broken(hits_jelly(BREAKS_ON_JELLY), 4)]


@pytest.mark.slow
def test_what_breaks_on_cloth_and_on_soft_matter_does_not_depend_on_the_number_of_threads():
    assert min(effect for _, effect in result_on_any_threads(broken_digests)) > 0.0


@pytest.mark.slow
def test_fluid_with_bodies_with_cloth_and_with_dye_does_not_depend_on_the_number_of_threads():
    assert min(effect for _, effect in result_on_any_threads(coupled_digests)) > 0.0
