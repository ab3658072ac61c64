"""The report: one file with charts of the solvers' numbers, timings, pictures and warnings; several jobs in one."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import drawing_stages
import pytest
from command_line import pipeline
from drawn_films import draw_film
from numbered_frames import commit, commit_whitewater, submitted, whitewater_task

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import FailureKind, Task, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.show.report.chart import Line, chart
from pipeline.show.report.page import write_report
from pipeline.show.report.panels import JobNumbers, panels_of
from pipeline.store.cache import FrameNumbers

# --- charts --------------------------------------------------------------------------------------------------------


def test_errors_over_decades_get_a_logarithmic_axis_and_zeros_leave_gaps():
    line = Line("a", [0.0, 1.0, 2.0, 3.0], [1.0, 0.1, 0.0, 0.01])
    drawn = chart([line], x_label="s", may_be_logarithmic=True)
    assert drawn["logarithmic"] is True
    assert drawn["lines"][0]["y"] == [1.0, 0.1, None, 0.01]
    plain = chart([line], x_label="s")
    assert plain["logarithmic"] is False
    assert plain["lines"][0]["y"] == [1.0, 0.1, 0.0, 0.01]


@pytest.mark.parametrize("values", [[0.0, 5e-324], [0.0, -0.0], [-1.0, 1e3], [1.0, 29.0], [math.nan, 1.0]])
def test_an_axis_is_linear_where_a_logarithmic_one_would_show_nothing(values):
    drawn = chart([Line("a", list(range(len(values))), values)], x_label="s", may_be_logarithmic=True)
    assert drawn["logarithmic"] is False


# --- panels --------------------------------------------------------------------------------------------------------


def numbers(name: str, *frames: dict[str, dict[str, float]], kinds: dict[str, str] | None = None) -> JobNumbers:
    return JobNumbers(
        name, tuple(FrameNumbers(index, index / 60, "cpu", of, kinds or {}) for index, of in enumerate(frames))
    )


TANK = numbers(
    "tank",
    {"water": {"substeps": 0, "kinetic_energy": 1.0, "potential_energy": 5.0, "elastic_energy": 0.5, "iterations": 0}},
    {"water": {"substeps": 4, "kinetic_energy": 2.0, "potential_energy": 3.0, "elastic_energy": 0.25, "iterations": 8}},
)


def panel(jobs: list[JobNumbers], title: str):
    return next(each for each in panels_of(jobs).panels if each.title == title)


def test_mechanical_energy_is_the_sum_of_its_parts():
    lines = {line.label: line.y for line in panel([TANK], "Energy").lines}
    assert lines["water, mechanical energy"] == [6.5, 5.25]
    assert lines["water, kinetic energy"] == [1.0, 2.0]


def test_the_energy_of_a_job_is_that_of_all_its_bodies():
    both = {"kinetic_energy": 1.0, "potential_energy": 2.0}
    job = numbers("a", {"water": both, "rigid": both, "plume": {"mass": 1.0}})
    assert job.total_energy() == [6.0]
    assert [line.label for line in panel([job], "Total mechanical energy").lines] == ["a"]


def test_jobs_are_compared_with_one_line_of_energy_each():
    other = numbers("other", {"water": {"kinetic_energy": 1.0, "potential_energy": 1.0}})
    lines = panel([TANK, other], "Total mechanical energy").lines
    assert [(line.label, list(line.y), line.color) for line in lines] == [("tank", [6.5, 5.25], 0), ("other", [2.0], 1)]


def test_lines_of_a_panel_can_be_told_apart():
    momentum = {f"momentum_{axis}": 1.0 for axis in "xyz"}
    job = numbers("a", {"water": momentum, "oil": momentum})
    for jobs in ([job], [job, numbers("b", {"water": momentum, "oil": momentum})]):
        lines = panel(jobs, "Momentum").lines
        assert len(lines) == 6 * len(jobs)
        assert len({(line.color, line.dash) for line in lines}) == len({line.label for line in lines}) == len(lines)


def test_quantities_of_one_kind_but_another_unit_have_a_panel_of_their_own():
    job = numbers("a", {"water": {"mass": 2.0}, "plume": {"mass": 3.0}}, kinds={"water": "fluid", "plume": "smoke"})
    assert {(each.title, each.unit) for each in panels_of([job]).panels} == {("Mass", "kg"), ("Smoke", "m³")}


def test_errors_are_drawn_in_per_cent():
    job = numbers("a", {"water": {"density_error": 1e-3, "substeps": 1}})
    (line,) = panel([job], "Density and divergence error").lines
    assert line.y == pytest.approx([0.1])


def test_the_first_frame_took_no_step_and_tells_no_iterations():
    (line,) = panel([TANK], "Solver iterations").lines
    assert math.isnan(line.y[0])
    assert line.y[1] == 8


def test_what_is_always_zero_is_said_and_not_drawn():
    found = panels_of([numbers("a", {"water": {"wall_contacts": 0.0, "max_speed": 2.0}})])
    assert [each.title for each in found.panels] == ["Largest speed"]
    assert found.zero == ("water: wall contacts",)


def test_iterations_residual_and_divergence_of_smoke_are_drawn_for_each_frame():
    start = {"substeps": 0, "mass": 0.0, "emitted_mass": 0.0, "max_temperature": 293.0, "max_speed": 0.0}
    solves = {"iterations": 0, "residual": 0.0, "divergence": 0.0, "not_converged": 0}
    frames = [{**start, **solves}]
    for iterations, residual, divergence, missed in ((12, 8e-6, 2e-4, 0), (200, 3e-4, 9e-3, 2)):
        solves = {"iterations": iterations, "residual": residual, "divergence": divergence, "not_converged": missed}
        frames.append({**start, **solves, "substeps": 2, "mass": 0.1, "max_speed": 1.0})
    job = numbers("a", *({"plume": each} for each in frames), kinds={"plume": "smoke"})
    expected = {
        "Solver iterations": [12, 200],
        "Residual": [8e-6, 3e-4],
        "Divergence": [2e-4, 9e-3],
        "Solves at their limit": [0, 2],
    }
    for title, values in expected.items():
        (line,) = panel([job], title).lines
        assert list(line.y)[1:] == values, title


# --- the page ------------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Elements of a page; every one that is opened has to be closed."""

    VOID = frozenset({"meta", "img", "link", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.addresses: list[str] = []
        self.data: dict[str, str] = {}
        self._script = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.count[tag] = self.count.get(tag, 0) + 1
        self.addresses += [value for name, value in attributes if name in ("src", "href")]
        if tag == "script":
            self._script = dict(attributes).get("id", "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):  # noqa: ARG002 - as the base class has it
        self.count[tag] = self.count.get(tag, 0) + 1

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.data[self._script] = self.data.get(self._script, "") + data

    def json(self, name: str):
        return json.loads(self.data[name])


@pytest.fixture
def layout(tmp_path) -> JobLayout:
    """A job with three frames, and a task that took two attempts."""
    layout = submitted(tmp_path / "tank")
    for frame in range(3):
        commit(layout, frame, kinetic_energy=float(frame), potential_energy=2.0, not_converged=float(frame == 2))
    task = Task(TaskId("simulate"), "simulate", (), (), ParameterSet.of(stage="simulate", version=1, tools={}))
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("tank")
        manifest.record_plan([task, whitewater_task(layout, 0)])
        lost = manifest.start_attempt(task.id)
        manifest.finish_attempt(task.id, lost, failure=FailureKind.WORKER_LOST, message="gone", seconds=1.0)
        manifest.finish_attempt(task.id, manifest.start_attempt(task.id), seconds=3.0, peak_memory_bytes=5 << 20)
        manifest.set_states({task.id: TaskState.SUCCEEDED})
        manifest.end_run()
    return layout


def read(path: Path) -> tuple[str, Page]:
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def report_of(layout: JobLayout) -> tuple[str, Page]:
    """The report of a job, written anew."""
    write_report([layout], layout.report)
    return read(layout.report)


def test_the_report_is_one_file_that_needs_no_other(layout, monkeypatch):
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)
    draw_film(layout, frames=1)
    result = pipeline("report", layout.root)
    assert result.exit_code == 0, result.output
    text, page = read(layout.report)
    assert result.output.strip() == str(layout.report)
    assert "@import" not in text and "url(" not in text
    assert page.addresses and all(address.startswith("data:image/webp;base64,") for address in page.addresses)


def test_the_report_tells_timings_warnings_and_draws_every_kind_of_quantity(layout):
    text, page = report_of(layout)
    assert "<th>simulate</th><td>2</td><td>1</td>" in text  # attempts, of which one failed
    assert "4.0 s</td><td>3.0 s</td><td>5.0 MiB</td>" in text  # all, the longest, the largest
    assert "water: 1 solve hit its iteration limit, frame 2" in text
    titles = re.findall(r"<figcaption>([^<]*)</figcaption>", text)
    assert titles == ["Substeps per frame", "Smallest time step [s]", "Solves at their limit", "Energy [J]"]
    assert page.count["figure"] == 4


def test_the_numbers_are_in_the_page_for_machines(layout):
    commit(layout, 3, kinetic_energy=math.inf, potential_energy=1.0)
    (job,) = report_of(layout)[1].json("numbers")["jobs"]
    assert job["frame"] == [0, 1, 2, 3]
    assert job["solvers"]["water"]["kinetic_energy"] == [0.0, 1.0, 2.0, None]  # JSON knows no infinity
    assert job["solvers"]["water"]["mechanical_energy"][:3] == [2.0, 3.0, 4.0]
    assert job["stages"][0] | {"bytes": 0} == {
        "stage": "simulate",
        "attempts": 2,
        "failed": 1,
        "seconds": 4.0,
        "longest_s": 3.0,
        "peak_memory_bytes": 5 << 20,
        "artifacts": 0,
        "bytes": 0,
    }
    assert job["warnings"][0]["frames"] == [2]


def test_the_facts_have_the_particles_of_each_fluid_of_a_tank(layout):
    water = "[[fluid]]" + layout.job_file.read_text().partition("[[fluid]]")[2]
    with layout.job_file.open("a") as file:
        file.write(water.replace("water", "oil"))
    commit(layout, 3, particle_count=1300.0)
    assert "<dt>water</dt><dd>WCSPH, 1,300 particles of radius" in report_of(layout)[0]
    commit(layout, 4, particle_count_water=1000.0, particle_count_oil=300.0)
    text, _ = report_of(layout)
    assert "<dt>water</dt><dd>WCSPH, 1,000 particles of radius" in text
    assert "<dt>oil</dt><dd>WCSPH, 300 particles of radius" in text


def test_the_facts_count_the_particles_that_left_the_domain(layout):
    assert "left the domain" not in report_of(layout)[0]
    commit(layout, 3, particle_count=1300.0, particles_removed=1234.0)
    text, _ = report_of(layout)
    assert "<dt>left the domain</dt><dd>1,234 particles of water</dd>" in text
    assert "Particles that left" in re.findall(r"<figcaption>([^<]*)</figcaption>", text)


def test_the_report_warns_of_whitewater_that_had_no_room_or_is_damaged(layout):
    commit_whitewater(layout, 3, commit(layout, 3), not_made=11)
    damaged = commit_whitewater(layout, 4, commit(layout, 4))
    layout.path(damaged.artifact).write_bytes(b"gone")
    text, _ = report_of(layout)
    assert "whitewater of water: 11 particles were not made, as there are max_particles, frame 3" in text
    assert "whitewater of water that cannot be read: frame 4" in text


def test_a_name_is_text_and_no_markup(tmp_path):
    layout = submitted(tmp_path / "<b>&<script>")
    write_report([layout, layout], tmp_path / "both.html")  # the same name twice, so each is called by its folder
    _, page = read(tmp_path / "both.html")
    assert "b" not in page.count
    assert len(page.json("numbers")["jobs"]) == 2


def test_jobs_in_comparison_share_their_charts(layout, tmp_path):
    other = submitted(tmp_path / "other", name="other")
    commit(other, 0, kinetic_energy=1.0, potential_energy=8.0)
    commit(other, 1, kinetic_energy=4.0, potential_energy=2.0)
    result = pipeline("report", layout.root, other.root, "-o", tmp_path / "c.html")
    assert result.exit_code == 0, result.output
    text, page = read(tmp_path / "c.html")
    assert "<th>other</th><td>9 J</td><td>6 J</td><td>3 J</td>" in text
    titles = re.findall(r"<figcaption>([^<]*)</figcaption>", text)
    drawn = dict(zip(titles, page.json("charts"), strict=True))["Total mechanical energy [J]"]
    assert [(line["label"], len(line["y"])) for line in drawn["lines"]] == [("tank", 3), ("other", 2)]
    assert not (tmp_path / "other/report.html").exists()


def test_a_comparison_must_be_told_where_to_go(layout, tmp_path):
    other = submitted(tmp_path / "other", name="other")
    result = pipeline("report", layout.root, other.root)
    assert result.exit_code == 2
    assert "-o comparison.html" in result.output


def test_a_job_without_frames_has_a_report_too(tmp_path):
    layout = submitted(tmp_path / "tank")
    text, page = report_of(layout)
    assert "No frame has been simulated yet." in text
    assert "figure" not in page.count
    assert page.json("charts") == []


def test_a_report_that_cannot_be_written_says_so(layout, tmp_path):
    result = pipeline("report", layout.root, "-o", tmp_path / "nowhere/r.html")
    assert result.exit_code == 1
    assert "No such file or directory" in result.output
