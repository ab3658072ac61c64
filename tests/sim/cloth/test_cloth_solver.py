"""The cloth solver as the world sees it: pins, live changes, restarts, threads, faults."""

import numpy as np
import pytest
import trimesh
from cloth_scenes import EARTH, SOFT, VACUUM, WEIGHTLESS, advance, cloth, rectangle, solver_of
from thread_counts import digest_of, result_on_any_threads

from sim.build import build_world
from sim.cloth.solver import ClothSolver
from sim.scene import SceneParameters
from validation.sheet_energy import elastic_energy

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FLAG = {"pin": [{"edge": "x-"}], "wind": (4.0, 1.0, 0.5), "damping": 1e-3}


def same_checkpoints(one, other):
    first, second = one.checkpoint(), other.checkpoint()
    assert first.keys() == second.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(second[name], array, err_msg=name)


# --- pins ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pin", "nodes"),
    [
        ({"corner": "x-y-"}, {0}),
        ({"corner": "x+y-"}, {3}),
        ({"corner": "x-y+"}, {8}),
        ({"corner": "x+y+"}, {11}),
        ({"edge": "x+"}, {3, 7, 11}),
        ({"edge": "y+"}, {8, 9, 10, 11}),
        ({"index": [5, 1, 5]}, {1, 5}),
        ({"region": {"type": "sphere", "position": (-0.3, -0.2, 0.0), "radius": 0.2}}, {0, 1, 4}),
        ({"region": {"type": "box", "min": (0.1, -1, -1), "max": (0.1, 1, 1)}}, {2, 6, 10}),
    ],
)
def test_pins_hold_the_nodes_that_they_name_and_all_others_fall(pin, nodes):
    solver = solver_of(cloth(shape=rectangle((0.6, 0.4), (4, 3)), pin=[pin]))
    start = solver.state.positions()
    advance(solver, 0.02)
    rested = np.flatnonzero((solver.state.positions() == start).all(axis=1))
    assert set(rested) == nodes


@pytest.mark.parametrize(
    ("pin", "message"),
    [
        ({"index": [12]}, r'cloth "sheet": pin\[0\]: index 12 does not exist; the sheet has nodes 0 to 11'),
        (
            {"region": {"type": "sphere", "position": (5, 0, 0), "radius": 1}},
            r"no node starts in its region; the cloth spans x -0.3..0.3 y -0.2..0.2 z 0..0 m",
        ),
    ],
)
def test_pins_that_hold_nothing_are_refused(pin, message):
    with pytest.raises(ValueError, match=message):
        solver_of(cloth(shape=rectangle((0.6, 0.4), (4, 3)), pin=[pin]))


def test_pins_that_pull_at_one_node_are_refused():
    path = [{"time_s": 0.0}, {"time_s": 1.0, "offset": (0, 0, 1)}]
    with pytest.raises(ValueError, match=r"pin\[1\] shares node 0 with another pin, and one of them moves"):
        solver_of(cloth(pin=[{"corner": "x-y-"}, {"edge": "x-", "keyframe": path}]))


def test_a_moving_pin_follows_its_path_and_turns_about_its_centre():
    path = [{"time_s": 0.0}, {"time_s": 0.1, "offset": (0, 0, 0.02), "rotation_deg": (90, 0, 0)}]
    solver = solver_of(cloth(pin=[{"edge": "x-", "keyframe": path, "interpolation": "linear"}]))
    held = np.arange(0, 81, 9)
    start = solver.state.positions()[held]
    steps = round(0.1 / solver.stable_dt())
    for _ in range(steps // 2):
        solver.substep(solver.stable_dt())
    half = solver.state.positions()[held]
    turned = np.stack([start[:, 0], start[:, 1] * np.sqrt(0.5), start[:, 1] * np.sqrt(0.5) + 0.01], axis=1)
    np.testing.assert_allclose(half, turned, atol=1e-6)  # float32 displacements of 1e-4 m, 60 of them
    speed = solver.state.velocity.to_numpy()[held[4]]
    np.testing.assert_allclose(speed, (0.0, 0.0, 0.2), atol=1e-4)
    advance(solver, 0.1)
    np.testing.assert_allclose(solver.state.positions()[held][:, 1], 0.0, atol=2e-6)


def test_a_pin_lets_go_at_its_time_with_the_speed_that_it_had():
    path = [{"time_s": 0.0}, {"time_s": 1.0, "offset": (0.5, 0, 0)}]
    pins = [{"edge": edge, "release_s": 0.05} for edge in ("x-", "x+")]
    whole = {"region": {"type": "box", "min": (-1, -1, -1), "max": (1, 1, 1)}, "release_s": 0.05}
    solver = solver_of(cloth(pin=[{**whole, "keyframe": path, "interpolation": "linear"}], **VACUUM))
    dt = solver.stable_dt()
    for _ in range(round(0.05 / dt)):
        solver.substep(dt)
    np.testing.assert_allclose(solver.state.velocity.to_numpy()[:, 0], 0.5, rtol=1e-4)
    advance(solver, 0.05)
    velocity = solver.state.velocity.to_numpy()
    np.testing.assert_allclose(velocity[:, 0], 0.5, rtol=1e-3)
    np.testing.assert_allclose(velocity[:, 2], -9.81 * 0.05, rtol=1e-3)
    both = solver_of(cloth(pin=[*pins, {"corner": "x-y-"}], **VACUUM))  # a corner of two pins: one still holds it
    advance(both, 0.1)
    np.testing.assert_allclose(both.state.positions()[0], both.state.host.position[0], atol=1e-12)
    assert both.state.positions()[72, 2] < -0.001


# --- what may change -----------------------------------------------------------------------------------------------


def test_changed_parameters_are_those_of_a_cloth_that_was_built_with_them():
    changes = {
        "stretch_stiffness": 900.0,
        "mass_per_area": 0.5,
        "wind": (0.0, 9.0, 0.0),
        "bend_stiffness": 1e-4,
        "damping": 2e-3,
        "friction": 0.1,
        "thickness": 0.002,
    }
    changed, built = solver_of(cloth(**FLAG)), solver_of(cloth(**{**FLAG, **changes}))
    changed.change("sheet", **changes)
    changed.gravity = built.gravity = (0.0, 0.0, -3.0)
    for solver in (changed, built):
        advance(solver, 0.05)
    same_checkpoints(changed, built)
    np.testing.assert_array_equal(changed.state.friction.to_numpy(), built.state.friction.to_numpy())
    assert changed.snapshots()["sheet"].attributes["thickness"] == 0.002


def test_what_would_need_a_new_cloth_cannot_change():
    solver = solver_of(cloth())
    with pytest.raises(ValueError, match="shape of a cloth cannot change while it is simulated"):
        solver.change("sheet", shape=rectangle((1, 1), (3, 3)))
    with pytest.raises(ValueError, match="greater than 0"):
        solver.change("sheet", mass_per_area=-1.0)


def test_a_change_that_explicit_springs_do_not_bear_leaves_the_solver_as_it_was():
    keys = {**SOFT, **FLAG, "integrator": "explicit", "substeps": 200}
    touched, untouched = solver_of(cloth(**keys)), solver_of(cloth(**keys))
    with pytest.raises(ValueError, match="give substeps = "):
        touched.change("sheet", stretch_stiffness=1e5, mass_per_area=0.1, wind=(9.0, 0.0, 0.0))
    assert touched.parameters == untouched.parameters
    assert touched.stable_dt() == untouched.stable_dt()
    for solver in (touched, untouched):
        advance(solver, 0.01)
    same_checkpoints(touched, untouched)


# --- the same bits -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["xpbd", "explicit"])
def test_continued_run_equals_the_uninterrupted_one_bit_for_bit(integrator):
    keys = {**SOFT, **FLAG, "integrator": integrator, "pin": [{"edge": "x-", "release_s": 0.06}]}
    whole, first, second = (solver_of(cloth(**keys)) for _ in range(3))
    advance(second, 0.013)  # whatever it did before, it is forgotten
    for solver in (whole, first):
        advance(solver, 0.05)
    second.restore(first.checkpoint())
    for solver in (whole, second):
        for frame in (3, 4):
            solver.begin_frame(frame / 60.0)
            advance(solver, 1.0 / 60.0)
    same_checkpoints(whole, second)


def test_a_run_continues_bit_for_bit_where_a_pin_lets_go_between_two_frames():
    """Springs at free nodes bear shorter steps than at held ones, and both runs have to know from the first step on."""
    corner = {"index": list(range(80)), "release_s": 2.0 / 60.0}
    keys = {**SOFT, "integrator": "explicit", "pin": [corner], "stretch_stiffness": 1e3, "velocity": (0.0, 0.0, 1.0)}
    whole, continued = solver_of(cloth(**keys)), solver_of(cloth(**keys))
    for frame in (0, 1):
        whole.begin_frame(frame / 60.0)
        held = whole.stable_dt()
        advance(whole, 1.0 / 60.0)
    continued.restore(whole.checkpoint())
    for solver in (whole, continued):
        solver.begin_frame(2.0 / 60.0)
    assert whole.stable_dt() == continued.stable_dt() < held
    for solver in (whole, continued):
        advance(solver, 0.01)
    same_checkpoints(whole, continued)


def test_a_checkpoint_of_another_cloth_is_refused():
    with pytest.raises(ValueError, match=r"lattice must have shape \(81, 3\), got shape \(9, 3\)"):
        solver_of(cloth()).restore(solver_of(cloth(shape=rectangle((1, 1), (3, 3)))).checkpoint())


def digests_of_flags() -> list[tuple[str, dict[str, float]]]:
    """Checkpoint and diagnostics of a flag in wind, by each integrator."""
    found = []
    for integrator in ("xpbd", "explicit"):
        keys = {"pin": [{"edge": "x-"}], "wind": (3, 1, 1), "integrator": integrator, "damping": 1e-4}
        solver = solver_of(cloth(**SOFT, **keys, shape=rectangle((1, 1), (90, 40))))
        for _ in range(25):
            solver.substep(solver.stable_dt())
        found.append((digest_of(solver.checkpoint()), dict(solver.diagnostics())))
    return found


def test_results_do_not_depend_on_the_number_of_threads():
    assert len(result_on_any_threads(digests_of_flags)) == 2


# --- in the world --------------------------------------------------------------------------------------------------


def test_a_scene_with_two_cloths_has_a_snapshot_of_each(tmp_path):
    path = tmp_path / "disc.ply"
    trimesh.creation.icosphere(subdivisions=2, radius=0.1).export(path)
    scene = SceneParameters(
        cloth=(
            cloth("flag", shape=rectangle((0.3, 0.2), (7, 5)), position=(0, 0, 0.5), thickness=0.001),
            cloth("balloon", shape={"type": "mesh", "file": str(path), "size": 0.1}, position=(0, 0, 0.8)),
        )
    )
    world = build_world(scene, frames_per_second=60)
    report = world.advance_frame()
    assert report.substeps == {"cloth": 20}
    flag, balloon = (world.snapshots()[name] for name in ("flag", "balloon"))
    assert flag.kind == balloon.kind == "cloth"
    assert flag.arrays["position"].shape == (35, 3)
    assert flag.arrays["triangles"].shape == (48, 3)
    assert balloon.arrays["triangles"].shape == (320, 3)
    assert balloon.arrays["triangles"].max() == len(balloon.arrays["position"]) - 1
    for snapshot, height in ((flag, 0.5), (balloon, 0.8)):
        fall = 0.5 * 9.81 / 60**2
        # Implicit steps fall half a step ahead: a twentieth of that.
        assert snapshot.arrays["position"][:, 2].mean() == pytest.approx(height - fall, abs=0.08 * fall)
        assert snapshot.arrays["velocity"].dtype == np.float32


def test_a_cloth_that_falls_for_ever_stops_far_outside():
    solver = solver_of(cloth(**VACUUM, velocity=(0, 0, -4000.0)))
    advance(solver, 1.0 / 60.0)
    assert solver.diagnostics()["nodes_lost"] == 81
    assert solver.diagnostics()["max_speed"] < 1e-3  # springs feel the rounding of nodes that were stopped


# --- faults --------------------------------------------------------------------------------------------------------


def test_explicit_springs_refuse_steps_that_are_too_long_and_say_how_many_they_need():
    with pytest.raises(ValueError, match=r"stable up to .* give substeps = (\d+) or more") as refusal:
        solver_of(cloth(integrator="explicit", substeps=20))
    least = int(str(refusal.value).split("substeps = ")[1].split()[0])
    assert solver_of(cloth(integrator="explicit", substeps=least)).stable_dt() == pytest.approx(1 / 60 / least)


def test_a_node_that_is_not_finite_is_found():
    solver = solver_of(cloth())
    assert solver.first_bad_quantity() is None
    velocity = solver.state.velocity.to_numpy()
    velocity[40, 1] = np.nan
    solver.state.velocity.from_numpy(velocity)
    solver.substep(solver.stable_dt())
    assert "velocity is not finite at" in (solver.first_bad_quantity() or "")


def test_a_node_that_runs_away_is_found():
    solver = solver_of(cloth(velocity=(2.0e4, 0.0, 0.0), **VACUUM), gravity=WEIGHTLESS)
    assert solver.first_bad_quantity() == "max_speed is 2e+04 m/s"


def test_cloths_with_other_integrators_are_refused():
    with pytest.raises(ValueError, match='cloth "b": integrator is "explicit", but "xpbd" in cloth'):
        solver_of(cloth("a"), cloth("b", integrator="explicit"))


def test_cloth_as_the_name_of_a_fluid_is_refused():
    water = {"name": "cloth", "block": [{"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}}]}
    scene = SceneParameters.model_validate({"cloth": [cloth().model_dump()], "fluid": [water]})
    with pytest.raises(ValueError, match='"cloth" is what all cloths are called together'):
        build_world(scene, frames_per_second=60)


def test_diagnostics_are_the_sums_over_the_nodes():
    solver = solver_of(cloth(**SOFT, pin=[{"corner": "x-y-"}]))
    assert isinstance(solver, ClothSolver)
    advance(solver, 0.1)
    numbers, state = solver.diagnostics(), solver.state
    mass, velocity = (array.to_numpy().astype(np.float64) for array in (state.mass, state.velocity))
    positions = state.positions()
    assert numbers["mass"] == pytest.approx(0.2 * 0.04, rel=1e-6)
    # Sums in float32 over 81 nodes: a few times 6e-8.
    assert numbers["kinetic_energy"] == pytest.approx(0.5 * mass @ (velocity**2).sum(axis=1), rel=1e-5)
    assert numbers["potential_energy"] == pytest.approx(-mass @ (positions @ EARTH), rel=1e-5)
    assert numbers["momentum_z"] == pytest.approx(mass @ velocity[:, 2], rel=1e-5)
    assert numbers["elastic_energy"] == pytest.approx(elastic_energy(solver, positions), rel=1e-3)
    assert numbers["max_speed"] == pytest.approx(np.linalg.norm(velocity, axis=1).max(), rel=1e-5)
    assert 0.0 < numbers["max_strain"] < 1.0
