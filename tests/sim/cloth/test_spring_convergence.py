"""Springs that are longer than their tension makes them are told from those that the material lets stretch."""

import numpy as np
import pytest
from cloth_scenes import FRAMES_PER_SECOND, VACUUM, cloth, energy, rectangle, solver_of
from contact_scenes import cloth_of, world_of

from sim.cloth.parameters import DEFAULT_SUBSTEPS, PinParameters
from sim.cloth.solver import ClothSolver
from sim.cloth.threads import LARGEST_RESIDUAL

pytestmark = pytest.mark.usefixtures("taichi_cpu")


def after(solver: ClothSolver, frames: int) -> ClothSolver:
    for frame in range(frames):
        solver.begin_frame(frame / FRAMES_PER_SECOND)
        for _ in range(round(1.0 / (FRAMES_PER_SECOND * solver.stable_dt()))):
            solver.substep(solver.stable_dt())
    return solver


def hung_by_a_corner(**keys) -> ClothSolver:
    """A metre of cotton whose weight 1024 nodes have to pass on to one."""
    sheet = {"shape": rectangle((1.0, 1.0), (32, 32)), "pin": [{"corner": "x-y+"}], "rotation_deg": (90.0, 0.0, 0.0)}
    return solver_of(cloth(**sheet, **VACUUM, **keys))


def test_too_few_substeps_draw_springs_out_and_more_of_them_and_of_sweeps_do_not():
    few, enough = (
        after(hung_by_a_corner(substeps=4, iterations=1), 20),
        after(hung_by_a_corner(substeps=20, iterations=4), 20),
    )
    assert few.diagnostics()["max_strain"] > 0.5
    assert few.diagnostics()["overlong_springs"] > 0
    assert enough.diagnostics()["max_strain"] < 0.5
    assert enough.diagnostics()["overlong_springs"] == 0


def test_soft_cloth_that_stretches_by_its_own_weight_has_no_overlong_springs():
    """0.15 kg/m² on an edge strain 1 m of 1 N/m by 1.5 at the top at rest, and by more as it falls into its pins."""
    soft = cloth(
        shape=rectangle((0.2, 1.0), (5, 33)),
        pin=[{"edge": "y+"}],
        rotation_deg=(90.0, 0.0, 0.0),
        stretch_stiffness=1.0,
        shear_stiffness=0.2,
        **VACUUM,
    )
    held = soft.model_copy(update={"name": "held", "pin": (soft.pin[0], PinParameters(edge="y-"))})
    for cloths in ((soft,), (soft, held)):  # rectangles are solved one after the other, in the same memory
        solver = after(solver_of(*cloths), 30)
        numbers = solver.diagnostics()
        assert numbers["max_strain"] > 1.0
        assert numbers["overlong_springs"] == 0
    assert solver.stable_dt() == pytest.approx(1.0 / (FRAMES_PER_SECOND * DEFAULT_SUBSTEPS))


def test_springs_between_pins_are_not_counted():
    """Those that hold both ends of a spring say how long it is."""
    led = [{"time_s": 0.0}, {"time_s": 0.1, "offset": (0.4, 0.0, 0.0)}]
    pins = [{"edge": "x-"}, {"edge": "x+", "keyframe": led}]
    numbers = after(solver_of(cloth(shape=rectangle((0.2, 0.2), (2, 9)), pin=pins)), 6).diagnostics()
    assert numbers["max_strain"] > 1.0
    assert numbers["overlong_springs"] == 0


def test_what_springs_exceed_their_tension_by_is_that_of_float64():
    # 70 nodes along x; a wave and a quarter more length are more than one sweep takes back.
    solver = solver_of(cloth(shape=rectangle((0.7, 0.2), (70, 21)), substeps=2, **VACUUM))
    state, dt = solver.state, solver.stable_dt()
    positions = state.positions() * (1.25, 1.25, 1.0)
    positions[:, 2] += 0.01 * np.sin(np.arange(len(positions)))
    state.set_positions(positions)
    solver.air.predict(solver.gravity, dt)
    solver._integrator.displace(dt, np.ones(1, dtype=int))
    (threads,) = solver._integrator._threads
    largest, count = threads.excess(state, dt)()
    nodes, law = (getattr(threads.springs.on_device, name).to_numpy() for name in ("nodes", "law"))
    rest, stiffness, _ = law.astype(np.float64).T
    places = state.lattice.to_numpy() * state.quantum + state.displacement.to_numpy()
    length = np.linalg.norm(np.diff(places[nodes.reshape(-1, 2)], axis=1)[:, 0], axis=1)
    excess = (length - rest + threads._work.multiplier.to_numpy() / (stiffness * dt**2)) / rest
    assert largest == pytest.approx(excess.max(), rel=1e-4)
    assert count == np.count_nonzero(excess > LARGEST_RESIDUAL) > 0


def test_steps_that_were_shortened_get_longer_again_whatever_the_iterations():
    """In single frames they swing by a third with what the cloth does on the tip, which differs by processor."""
    world = on_the_tip_of_a_cone(iterations=1)
    substeps = [world.advance_frame().substeps["cloth"] for _ in range(40)]
    assert np.mean(substeps[-10:]) < 0.6 * max(substeps)


def on_the_tip_of_a_cone(**keys):
    """Cotton whose weight a few nodes have to bear, which fall on the tip."""
    cone = {"shape": {"type": "cone", "radius": 0.1, "height": 0.3}, "position": (0.0, 0.0, 0.15)}
    sheet = {"shape": rectangle((0.6, 0.6), (31, 31)), "position": (0.0, 0.0, 0.31)}
    return world_of({**sheet, **keys}, bodies=[cone])


def test_cloth_on_a_tip_gains_no_energy_and_does_not_stretch():
    """In 20 substeps a frame, always, what the cone pushes out and threads pull back in ends in 45 times the energy."""
    world = on_the_tip_of_a_cone()
    solver = cloth_of(world)
    start = energy(solver)
    energies, strains, substeps = [], [], []
    for _ in range(20):
        substeps.append(world.advance_frame().substeps["cloth"])
        energies.append(energy(solver))
        strains.append(solver.diagnostics()["max_strain"])
    assert max(energies) < 1.05 * start
    assert max(strains) < 0.2
    assert substeps[0] == DEFAULT_SUBSTEPS < max(substeps)


def test_steps_that_were_shortened_stay_so_over_a_checkpoint_and_those_that_are_asked_for_stay_as_they_are():
    world = on_the_tip_of_a_cone()
    usual_dt = 1.0 / (FRAMES_PER_SECOND * DEFAULT_SUBSTEPS)
    while cloth_of(world).stable_dt() > 0.6 * usual_dt:
        assert world.frame < 20
        world.advance_frame()
    resumed, asked = on_the_tip_of_a_cone(), on_the_tip_of_a_cone(substeps=DEFAULT_SUBSTEPS)
    for other in (resumed, asked):
        other.restore(world.frame, world.checkpoint())
    counts = [each.advance_frame().substeps["cloth"] for each in (world, resumed, asked)]
    assert counts[0] == counts[1] > counts[2] == DEFAULT_SUBSTEPS
    np.testing.assert_array_equal(cloth_of(resumed).state.positions(), cloth_of(world).state.positions())
