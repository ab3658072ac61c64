"""What the solvers tell of a job: the last frame's numbers, and warnings counted over all frames."""

import json

import pytest
from command_line import pipeline
from numbered_frames import commit, commit_whitewater, plan, submitted, whitewater_task

from pipeline.base.layout import JobLayout
from pipeline.base.quantities import quantity
from pipeline.base.task import TaskId
from pipeline.job.loading import load_job
from pipeline.run.events import Committed
from pipeline.run.plan import plan_job
from pipeline.run.solver_numbers import SolverWatch, count_warnings, simulation_numbers
from pipeline.stages import STAGES
from pipeline.store.cache import FrameNumbers, read_numbers


@pytest.fixture
def layout(tmp_path) -> JobLayout:
    return submitted(tmp_path / "tank")


def status(layout: JobLayout, *options: str) -> str:
    result = pipeline("status", layout.root, *options)
    assert result.exit_code == 0, result.output
    return result.output


def test_status_shows_the_last_frames_numbers_with_their_units(layout):
    commit(layout, 0, density_error=0.5)
    commit(layout, 1, iterations=3.0, density_error=8.1e-4, particle_count=12500.0, momentum_z=-2.5, odd_number=7.25)
    text = status(layout)
    assert "water, frame 1 at 0.01667 s:" in text
    for item in (
        "substeps 12",
        "smallest time step 0.00125 s",
        "iterations 3",
        "density error 0.081 %",
        "particles 12,500",
        "momentum z -2.5 kg m/s",
        "odd number 7.25",  # a name that nobody has told the program about
    ):
        assert item in text.replace("\n    ", " ")
    assert "warning" not in text


@pytest.mark.parametrize(
    ("name", "counts", "warning"),
    [
        ("not_converged", [0, 1, 0, 0, 2, 1, 0], "4 solves hit their iteration limit, frames 1, 4-5"),
        ("not_converged", [0, 0, 1], "1 solve hit its iteration limit, frame 2"),
        (
            "bodies_lost",
            [0, 0, 1, 1, 3, 3],
            "3 bodies fell out of sight and were stopped, frames 2, 4",
        ),
        ("crossings_left", [0, 2, 0, 1], "3 crossings of cloth could not be prevented, frames 1, 3"),
    ],
)
def test_what_should_not_happen_is_counted_with_its_frames(layout, name, counts, warning):
    """Lost bodies are told as a total since the start."""
    for frame, count in enumerate(counts):
        commit(layout, frame, **{name: float(count)})
    assert f"warning: water: {warning}" in status(layout)


@pytest.mark.parametrize(
    ("solver", "kinds"), [("tank", {"tank": "fluid"}), ("fluid", {"water": "fluid", "oil": "fluid"})]
)
def test_a_warning_says_what_it_means_for_its_kind_and_what_to_set(solver, kinds):
    """The solver of several fluids is called as their kind."""
    frame = FrameNumbers(3, 0.05, "cpu", {solver: {"not_converged": 2.0}, "plume": {"not_converged": 1.0}}, kinds)
    of_fluid, of_plume = count_warnings([frame])
    assert "max_iterations" in str(of_fluid)
    assert str(of_plume) == "plume: 1 solve hit its iteration limit, frame 3"


def test_joints_that_fight_are_named(layout):
    commit(layout, 0, joints_apart=1.0, joints_apart_rod=1.0)
    commit(layout, 1, joints_apart=9.0, joints_apart_crank=9.0, joints_apart_rod=2.0)
    assert "10 steps left joints apart (rod, crank), frames 0-1" in status(layout)
    assert 'steps with "crank" apart 9' in status(layout).replace("\n    ", " ")


def test_status_for_machines_has_all_of_it(layout):
    commit(layout, 0, not_converged=2.0)
    commit(layout, 1, kinetic_energy=4.0)
    told = json.loads(status(layout, "--json"))["simulation"]
    assert told["frame"] == 1
    assert told["solvers"] == {"water": {"substeps": 12, "smallest_dt_s": 1.25e-3, "kinetic_energy": 4.0}}
    assert told["warnings"] == [
        {
            "solver": "water",
            "name": "not_converged",
            "count": 2,
            "frames": [0],
            "text": str(simulation_numbers(layout).warnings()[0]),
        }
    ]


def test_status_of_a_job_without_frames_says_nothing_of_solvers(layout):
    assert "frame" not in status(layout)
    assert json.loads(status(layout, "--json"))["simulation"]["frame"] is None


def test_frames_of_an_earlier_version_of_the_simulation_do_not_count(layout):
    for frame in range(3):
        commit(layout, frame, fingerprint="old", not_converged=1.0)
    commit(layout, 0, fingerprint="new", not_converged=0.0)
    numbers = simulation_numbers(layout)
    assert [each.frame for each in numbers.frames] == [0]
    assert numbers.warnings() == []


def test_a_frame_that_cannot_be_read_is_said(layout):
    commit(layout, 0)
    commit(layout, 1)
    layout.path(layout.frame_cache(1)).write_bytes(b"gone")
    text = status(layout)
    assert "water, frame 0" in text
    assert "frames of the cache that cannot be read: 1; see: pipeline verify" in text


def test_only_the_numbers_that_are_asked_for_are_read(layout):
    receipt = commit(layout, 0, not_converged=1.0, mass=2.0)
    numbers = read_numbers(layout.path(receipt.artifact), ["not_converged", "not_there"])
    assert numbers.solvers == {"water": {"not_converged": 1.0}}


def test_a_run_tells_a_warning_once_when_it_first_happens(layout):
    said: list[str] = []
    watch = SolverWatch(layout, said.append)
    for frame, count in enumerate([0, 3, 1]):
        receipt = commit(layout, frame, not_converged=float(count))
        watch.notify(Committed(TaskId("simulate"), 1, receipt))
    (once,) = said
    assert once.startswith("water: 3 solves hit their iteration limit, frame 1: ")
    assert once.endswith("; later ones are counted: pipeline status")


def test_whitewater_that_had_no_room_is_counted_with_its_frames(layout):
    for frame, not_made in enumerate([0, 0, 30, 12, 0]):
        commit_whitewater(layout, frame, commit(layout, frame), points=10 * frame, not_made=not_made)
    text = status(layout)
    assert "warning: whitewater of water: 42 particles were not made, as there are max_particles, frames 2-3\n" in text
    assert "whitewater of water, frame 4" in text
    assert "whitewater particles 40" in text


def test_whitewater_of_an_earlier_version_of_the_simulation_does_not_count(layout):
    commit_whitewater(layout, 0, commit(layout, 0, kinetic_energy=1.0), not_made=5)
    commit(layout, 0, kinetic_energy=2.0)
    assert simulation_numbers(layout).warnings() == []


def test_whitewater_that_cannot_be_read_is_said(layout):
    plan(layout, *(whitewater_task(layout, 0, fluid=fluid) for fluid in ("oil", "water")))
    for frame in range(5):
        cached = commit(layout, frame)
        for fluid in ("oil", "water"):
            receipt = commit_whitewater(layout, frame, cached, fluid=fluid)
            if frame in ((2,) if fluid == "oil" else (0, 3, 4)):
                layout.path(receipt.artifact).write_bytes(b"gone")
    text = status(layout)
    assert "water, frame 4" in text
    assert "whitewater of oil that cannot be read: frame 2; see: pipeline verify" in text
    assert "whitewater of water that cannot be read: frames 0, 3-4; see: pipeline verify" in text
    assert json.loads(status(layout, "--json"))["simulation"]["unreadable_whitewater"] == [
        "whitewater/oil/000002.ply",
        *(f"whitewater/water/00000{frame}.ply" for frame in (0, 3, 4)),
    ]


def test_whitewater_of_an_earlier_format_is_counted_without_what_had_no_room(layout):
    receipt = commit_whitewater(layout, 0, commit(layout, 0), points=7)
    path = layout.path(receipt.artifact)
    path.write_bytes(path.read_bytes().replace(b"comment not_made 0\n", b""))
    numbers = simulation_numbers(layout)
    assert numbers.unreadable_whitewater == ()
    assert numbers.last.solvers["whitewater of water"] == {"whitewater_particles": 7.0}


def test_whitewater_of_replaced_parameters_does_not_count(layout):
    """Of a run that was stopped after two frames of five had been made anew; the other fluid's are as they were."""
    plan(layout, *(whitewater_task(layout, 0, fluid=fluid) for fluid in ("oil", "water")))
    cached = [commit(layout, frame) for frame in range(5)]
    for frame, of in enumerate(cached):
        commit_whitewater(layout, frame, of, fluid="oil", not_made=1, rate=1.0)
        commit_whitewater(layout, frame, of, not_made=10, rate=1.0)
    for frame in (0, 1):
        commit_whitewater(layout, frame, cached[frame], not_made=2, rate=2.0)
    assert {each.solver: (each.count, each.frames) for each in simulation_numbers(layout).warnings()} == {
        "whitewater of oil": (5, (0, 1, 2, 3, 4)),
        "whitewater of water": (4, (0, 1)),
    }


def test_whitewater_that_the_stages_plan_for_the_job_counts(layout):
    plan(layout, *plan_job(load_job(layout.job_file), layout, STAGES))
    commit_whitewater(layout, 0, commit(layout, 0), points=4)
    assert simulation_numbers(layout).last.solvers["whitewater of water"]["whitewater_particles"] == 4.0


def test_whitewater_that_the_job_no_longer_has_does_not_count(layout):
    cached = commit(layout, 0)
    commit_whitewater(layout, 0, cached, points=4)
    commit_whitewater(layout, 0, cached, fluid="oil", not_made=3)
    numbers = simulation_numbers(layout)
    assert numbers.warnings() == []
    assert set(numbers.last.solvers) == {"water", "whitewater of water"}
    plan(layout)
    assert set(simulation_numbers(layout).last.solvers) == {"water"}


def test_a_run_tells_when_whitewater_first_has_no_room(layout):
    said: list[str] = []
    watch = SolverWatch(layout, said.append)
    for frame, not_made in enumerate([0, 7, 9]):
        receipt = commit_whitewater(layout, frame, commit(layout, frame), not_made=not_made)
        watch.notify(Committed(receipt.task, 1, receipt))
    assert said == [
        "whitewater of water: 7 particles were not made, as there are max_particles, frame 1; "
        "later ones are counted: pipeline status"
    ]


def test_particles_of_each_fluid_of_a_tank_are_told_by_its_name(layout):
    commit(layout, 0, particle_count=1300.0, particle_count_oil=300.0, particle_count_water=1000.0, contacts=1.0)
    text = status(layout).replace("\n    ", " ")
    assert "particles 1,300, particles of oil 300, particles of water 1,000, contacts 1" in text


def test_the_mass_of_smoke_is_no_kilogram():
    assert quantity("mass").text(2.0) == "2 kg"
    assert quantity("mass", of_kind="smoke").text(2.0) == "2 m³"
