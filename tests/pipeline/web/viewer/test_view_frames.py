"""Frames of a job as `pipeline view` reads them, before anything is drawn."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viewed_job
from command_line import pipeline

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.store.cache import read_frame, read_numbers
from pipeline.web.bounded_cache import BoundedCache
from pipeline.web.drawing.bodies import Extents, body_of
from pipeline.web.drawing.canvas import box_edges, camera_orientation, vertical_fov
from pipeline.web.drawing.colors import ramp, srgb
from pipeline.web.drawing.shapes import Smoke, arrays_of
from pipeline.web.drawing.smoke_pictures import cut, points
from pipeline.web.viewer.committed import CommittedFrames, artifacts_of_frame
from pipeline.web.viewer.frames import ShownFrame, read_shown_frame
from pipeline.web.viewer.numbers import SolverSeries, plot_data, table
from pipeline.web.viewer.playback import Playback
from pipeline.web.viewer.texts import lacking, legend, thinned
from render.camera_path import View
from render.visibility import in_picture


def shown(layout: JobLayout, frame: int, *, most: int = 10_000) -> ShownFrame:
    committed = CommittedFrames(layout)
    committed.update()
    return read_shown_frame(load_job(layout.job_file), layout, committed, frame, most_particles=most)


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    return viewed_job.submitted(tmp_path / "job")


# --- which frames there are ----------------------------------------------------------------------------------------


def test_a_frame_without_a_receipt_is_not_there(layout):
    viewed_job.commit(layout, 0)
    half = layout.path(layout.frame_cache(1))
    half.write_bytes(layout.path(layout.frame_cache(0)).read_bytes()[:1000])
    committed = CommittedFrames(layout)
    assert committed.update()
    assert committed.numbers == (0,)
    assert not committed.update()
    viewed_job.commit(layout, 1)
    assert committed.update()
    assert committed.numbers == (0, 1)


def test_the_stamp_of_a_frame_changes_when_its_surface_or_its_drops_arrive(layout):
    job, cached = load_job(layout.job_file), viewed_job.commit(layout, 0)
    committed = CommittedFrames(layout)
    before = committed.stamp(artifacts_of_frame(job, layout, 0))
    viewed_job.commit_surface(layout, cached, 0)
    with_surface = committed.stamp(artifacts_of_frame(job, layout, 0))
    assert with_surface != before
    viewed_job.commit_drops(layout, cached, 0)
    assert committed.stamp(artifacts_of_frame(job, layout, 0)) != with_surface


# --- what a frame has ----------------------------------------------------------------------------------------------


def test_every_kind_of_body_is_read(layout):
    cached = viewed_job.commit(layout, 4)
    viewed_job.commit_surface(layout, cached, 4)
    viewed_job.commit_spray(layout, cached, 4)
    viewed_job.commit_drops(layout, cached, 4)
    frame = shown(layout, 4)
    bodies = viewed_job.bodies_at(4)
    water = frame.clouds["water"]
    assert set(water.values) == {"speed", "density"}
    assert np.array_equal(water.position, bodies["water"].arrays["position"])
    assert water.values["speed"] == pytest.approx(np.linspace(0.0, 2.0, viewed_job.PARTICLES), abs=1e-6)
    assert frame.bodies["ball"].position.tolist() == pytest.approx([0.7, 0.3, 0.58])
    assert len(frame.bodies["flag"].triangles) == 32
    assert float(frame.bodies["plume"].density.sum()) == pytest.approx(float(bodies["plume"].arrays["density"].sum()))
    assert len(frame.whitewater["water"].position) == 50
    assert len(frame.drops["water"].position) == 30
    assert frame.view is not None
    assert frame.troubles == ()
    assert frame.numbers.time_s == read_frame(layout.path(layout.frame_cache(4))).time_s
    for name, snapshot in bodies.items():  # live draws the same of a snapshot as the viewer of a cached frame
        if snapshot.kind != "smoke":  # whose cells without smoke are not read
            read, made = (list(arrays_of(body)) for body in (frame.bodies[name], body_of(snapshot, 10_000)))
            assert all(np.array_equal(*pair) for pair in zip(read, made, strict=True))


def test_reading_changes_no_file(layout):
    cached = viewed_job.commit(layout, 0)
    viewed_job.commit_surface(layout, cached, 0)
    before = {path: path.stat().st_mtime_ns for path in layout.root.rglob("*")}
    shown(layout, 0)
    assert {path: path.stat().st_mtime_ns for path in layout.root.rglob("*")} == before


def test_thinned_particles_are_the_same_ones_in_every_frame(layout):
    for frame in (0, 5):
        viewed_job.commit(layout, frame)
    first, later = (shown(layout, frame, most=300).clouds["water"] for frame in (0, 5))
    assert (len(first.position), first.count) == (250, 1000)  # every fourth
    assert later.position - first.position == pytest.approx(np.tile([0.25, 0.0, 0.0], (250, 1)), abs=1e-6)
    assert len(first.values["density"]) == 250


def test_a_spoilt_frame_is_an_error_and_a_spoilt_surface_a_line(layout):
    cached = viewed_job.commit(layout, 0)
    viewed_job.commit_surface(layout, cached, 0)
    layout.path(layout.surface("water", 0)).write_bytes(b"ply\nnothing\n")
    frame = shown(layout, 0)
    assert frame.surfaces == {}
    assert "pipeline verify" in frame.troubles[0]
    layout.path(layout.frame_cache(0)).write_bytes(b"nothing")
    with pytest.raises(InvalidArtifactError):
        shown(layout, 0)


def test_the_view_of_a_camera_that_moves_is_that_of_its_frame(tmp_path):
    camera = 'position = [2.0, -2.0, 1.0]\nlook_at = "ball"\norbit_deg_per_s = 90.0'
    layout = viewed_job.submitted(tmp_path / "orbit", camera=camera)
    for frame in (0, 6):
        viewed_job.commit(layout, frame)
    start, later = (shown(layout, frame).view for frame in (0, 6))
    assert start is not None
    assert later is not None
    assert later.look_at == pytest.approx((0.7, 0.3, 0.52))
    assert later.position != start.position


def test_a_camera_that_frames_the_action_is_unknown_until_the_film_is(tmp_path):
    layout = viewed_job.submitted(tmp_path / "action", camera='framing = "action"')
    viewed_job.commit(layout, 0)
    assert shown(layout, 0).view is None


def test_the_camera_of_a_film_is_unknown_while_that_is_simulated_anew(tmp_path):
    layout = viewed_job.submitted(tmp_path / "action", frames=3, camera='framing = "action"')
    for frame in range(3):
        viewed_job.commit(layout, frame)
    viewed_job.commit_bounds(layout, 3)
    assert shown(layout, 0).view is not None
    for frame in range(3):
        viewed_job.commit(layout, frame, fingerprint="anew", energy=7.0)
        assert shown(layout, frame).view is None
        assert shown(layout, 0).view is None
    viewed_job.commit_bounds(layout, 3)
    assert shown(layout, 0).view is not None


@pytest.mark.parametrize("aspect", [16 / 9, 1.0, 0.5])
def test_the_frustum_is_what_the_film_sees(aspect):
    view = View((2.0, -3.0, 1.5), (0.1, 0.2, 0.3), 35.0, 3.0)
    w, x, y, z = camera_orientation(view)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    up = math.tan(vertical_fov(view, aspect) / 2.0)
    for inside, share in ((True, 0.99), (False, 1.01)):
        corners = np.array([[sx * share * up * aspect, sy * share * up, 1.0] for sx in (-1, 1) for sy in (-1, 1)])
        seen = in_picture(view, np.array(view.position) + corners @ matrix.T, aspect=aspect)
        assert (seen == inside).all()
    assert matrix[2, 1] < 0.0  # its second axis points down


def test_a_box_has_twelve_edges_of_its_lengths():
    edges = box_edges((0.0, 0.0, 0.0), (1.0, 2.0, 4.0))
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    assert sorted(lengths.tolist()) == [1.0] * 4 + [2.0] * 4 + [4.0] * 4


# --- memory --------------------------------------------------------------------------------------------------------


def test_what_is_kept_stays_below_its_limit_and_the_oldest_goes_first():
    kept: BoundedCache[int, bytes] = BoundedCache(25, len)
    for number in range(4):
        kept.put(number, "state", bytes(10))
        assert kept.bytes <= 25
    assert kept.get(0, "state") is None
    assert kept.get(2, "state") == kept.get(3, "state") == bytes(10)
    assert kept.get(3, "another state") is None  # its files were replaced
    kept.put(5, "state", bytes(99))  # the last one stays in any case
    assert (len(kept), kept.bytes) == (1, 99)


@pytest.mark.parametrize("most", [1, 200])
def test_a_kept_frame_keeps_no_array_in_memory_that_is_larger_than_what_is_shown(layout, most):
    cached = viewed_job.commit(layout, 0)
    viewed_job.commit_surface(layout, cached, 0)
    viewed_job.commit_spray(layout, cached, 0, points=500)
    viewed_job.commit_drops(layout, cached, 0, points=500)
    frame = shown(layout, 0, most=most)
    arrays = [frame.surfaces["water"].vertices, frame.surfaces["water"].faces]
    for cloud in (frame.clouds["water"], frame.whitewater["water"], frame.drops["water"]):
        assert len(cloud.position) < 500
        arrays += [cloud.position, *cloud.values.values()]
    for array in arrays:
        assert array.base is None or array.base.nbytes == array.nbytes
    assert [each.partition(":")[0] for each in thinned(frame)] == ["water", "drops of water", "whitewater of water"]


# --- playing -------------------------------------------------------------------------------------------------------


def test_a_slow_page_misses_frames_and_keeps_the_pace():
    head = Playback(rate=30.0)
    head.offer(range(100))
    head.play(10.0)
    assert head.advance(10.01) == 0
    assert head.advance(10.04) == 1
    assert head.advance(11.0 + 1e-6) == 30
    assert head.wait(11.0 + 1e-6) == pytest.approx(1 / 30, abs=1e-4)


def test_a_film_begins_again_or_stays_at_its_end():
    head = Playback(rate=10.0)
    head.offer([0, 1, 2, 5])
    head.play(0.0)
    assert head.advance(0.55) == 1
    head.repeats = False
    assert head.advance(5.0) == 5
    assert not head.plays
    head.play(6.0)
    assert head.frame == 0


def test_frames_that_arrive_leave_the_one_that_is_seen_in_place():
    head = Playback(rate=10.0)
    assert head.advance(0.0) is None
    head.offer([0, 1])
    head.seek(1)
    head.offer([0, 1, 2, 3])
    assert head.frame == 1
    head.offer([0, 1, 2, 3, 4], follow=True)
    assert head.frame == 4
    head.offer([0, 1])  # simulated anew
    assert head.frame == 1
    head.seek(7)
    assert head.frame == 1
    head.step(-5)
    assert head.frame == 0


def test_another_rate_does_not_jump():
    head = Playback(rate=60.0)
    head.offer(range(1000))
    head.play(0.0)
    head.set_rate(1.0, 1.0 + 1e-6)
    assert head.advance(1.0 + 2e-6) == 60
    assert head.advance(2.1) == 61
    head.pause(3.1)
    assert head.frame == 62
    assert head.wait(4.0) is None


# --- colours, smoke, numbers ---------------------------------------------------------------------------------------


def test_colours_go_from_the_first_to_the_last_and_round_the_middle():
    colors = ramp([0.0, 1.0, 2.0, math.nan, 99.0], 0.0, 2.0)
    assert colors[0].tolist() == [0x26, 0x33, 0x7A]
    assert colors[2].tolist() == colors[4].tolist() == [0xD4, 0x3D, 0x3D]
    assert colors[3].tolist() == colors[0].tolist()
    low, middle, high = ramp([900.0, 1000.0, 1100.0], 900.0, 1100.0, around=True).astype(int)
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert np.ptp(middle) < 16  # neutral
    assert ramp([3.0], 3.0, 3.0).shape == (1, 3)
    assert srgb((0.0, 0.214, 1.0)) == (0, 127, 255)


def test_colours_mean_the_same_in_every_frame(layout):
    viewed_job.commit(layout, 0)
    frame, extents = shown(layout, 0), Extents()
    extents.see(frame.bodies)
    water = frame.clouds["water"]
    assert extents.range("speed", water).high == 2.0
    extents.top_speed = 7.0
    assert extents.range("speed", water).high == 7.0
    density = extents.range("density", water)
    assert (density.low + density.high) / 2 == water.rest_density


def test_pressures_are_coloured_from_none_on_and_single_peaks_do_not_darken_all_others(layout):
    viewed_job.commit(layout, 0)
    frame, extents = shown(layout, 0), Extents()
    water = frame.clouds["water"]
    pressures = np.linspace(500.0, 2000.0, len(water.position)).astype(np.float32)
    pressures[7] = 1.0e5
    with_pressures = replace(water, values={**water.values, "pressure": pressures})
    extents.see({"water": with_pressures})
    span = extents.range("pressure", with_pressures)
    assert span.low == 0.0
    assert 1900.0 < span.high < 2000.0
    assert "Pa" in legend("pressure", span)


def test_a_cache_of_an_earlier_version_is_said_to_hold_no_pressures(layout):
    viewed_job.commit(layout, 0)
    frame = shown(layout, 0)
    (line,) = lacking(frame)
    assert line.startswith("water: the cache holds no pressures")
    water = frame.clouds["water"]
    values = {**water.values, "pressure": np.zeros(len(water.position), np.float32)}
    assert lacking(replace(frame, bodies={"water": replace(water, values=values)})) == []


def plume() -> Smoke:
    """Cells 2 x 3 x 4 at (1, 0, 0); the upper right one of each layer along x is dense."""
    density = np.zeros((2, 3, 4), np.float32)
    density[:, 2, 3] = [1.0, 0.5]
    return Smoke("smoke", density, (1.0, 0.0, 0.0), 0.5)


def test_a_slice_stands_where_it_was_cut_and_shows_that_layer():
    box = ((0.0, 0.0, 0.0), (2.0, 1.5, 2.0))
    across = cut(plume(), axis="x", share=0.75, box=box, densest=1.0)
    assert across is not None
    assert across.corner.tolist() == [1.5, 0.0, 0.0]
    assert (across.right.tolist(), across.up.tolist()) == ([0.0, 1.5, 0.0], [0.0, 0.0, 2.0])
    brightness = across.picture[..., 0].astype(int)
    rows, columns = np.nonzero(brightness == brightness.max())
    assert rows.max() < brightness.shape[0] / 4  # on top
    assert columns.min() >= brightness.shape[1] * 2 / 3 - 1  # on the right
    assert cut(plume(), axis="x", share=0.25, box=box, densest=1.0) is None
    assert cut(plume(), axis="x", share=1.0, box=box, densest=1.0) is not None
    nothing = Smoke("smoke", np.zeros((0, 0, 0), np.float32), (0.0, 0.0, 0.0), 0.5)
    assert cut(nothing, axis="x", share=0.0, box=box, densest=0.0) is None


def test_points_of_smoke_are_the_middles_of_its_cells_and_never_too_many():
    found = points(plume(), densest=1.0)
    assert found.position.tolist() == [[1.25, 1.25, 1.75], [1.75, 1.25, 1.75]]
    assert found.colors[0, 0] > found.colors[1, 0]
    full = Smoke("smoke", np.ones((20, 20, 20), np.float32), (0.0, 0.0, 0.0), 0.1)
    thin = points(full, densest=1.0, most=500)
    assert (len(thin.position), thin.count) == (500, 8000)


def test_numbers_are_told_and_plotted_with_a_mark_at_the_frame(layout):
    series = SolverSeries()
    for frame in range(4):
        viewed_job.commit(layout, frame)
        series.put(read_numbers(layout.path(layout.frame_cache(frame))), source="f")
    assert series.has(3, source="f")
    assert not series.has(3, source="g")
    assert series.first_choice() == ("water", "kinetic_energy")
    assert series.of("water", "kinetic_energy") == ([0, 1, 2, 3], [0.0, 1.0, 4.0, 9.0])
    assert series.of("water", "mechanical_energy")[1] == [5.0, 6.0, 9.0, 14.0]
    assert series.of("water", "density_error")[1] == pytest.approx([0.1] * 4)  # per cent
    assert series.largest("max_speed") == 2.0
    x, y, so_far = plot_data([0, 1, 2, 3], [0.0, 1.0, 4.0, 9.0], 2)
    assert (x.tolist(), y.tolist()) == ([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 4.0, 9.0])
    assert so_far.tolist() == [0.0, 1.0, 4.0, 4.0]
    assert plot_data([0, 1], [5.0, 6.0], None)[2].tolist() == [5.0, 6.0]
    assert [len(each) for each in plot_data([], [], 3)] == [0, 0, 0]
    html = table(read_numbers(layout.path(layout.frame_cache(3))))
    assert "kinetic energy" in html
    assert "9 J" in html


def test_a_job_that_was_never_submitted_is_told(tmp_path):
    result = pipeline("view", tmp_path / "nothing")
    assert result.exit_code == 1
    assert "no submitted job" in result.output
