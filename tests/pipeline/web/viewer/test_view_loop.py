"""The loop behind the viewer's page, with a server but without a browser."""

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import viewed_job
import viser
from inline_tasks import run_task
from page_threads import threads_that_push
from scipy.spatial.transform import Rotation
from websockets.sync.client import connect

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES
from pipeline.stages.bodies import BodiesStage
from pipeline.store.receipts import read_receipt
from pipeline.web.drawing.canvas import Canvas
from pipeline.web.drawing.shapes import Smoke
from pipeline.web.drawing.smoke_pictures import cut
from pipeline.web.serving import in_its_loop, page_server
from pipeline.web.viewer.page import ViewPage
from render.meshes import read_ply


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    layout = viewed_job.submitted(tmp_path / "job")
    for frame in range(6):
        viewed_job.commit(layout, frame)
    return layout


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with page_server(port=0, label="view") as server:
        yield server


def page_of(server: viser.ViserServer, layout: JobLayout) -> ViewPage:
    page = ViewPage(server, layout, most_particles=10_000, most_bytes=10**8)
    page.advance(0.0)
    return page


def test_a_page_that_reads_nothing_holds_up_nobody_and_costs_no_memory(server, layout):
    page = page_of(server, layout)
    buffer = server._websock_server._broadcast_buffer
    address = f"ws://127.0.0.1:{server.get_port()}"
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_queue=1, close_timeout=0.1) as slow:
        assert slow.recv()  # it is connected, and reads no more
        sizes = []
        for number in range(60):
            page.playback.seek(number % 6)
            page.advance(float(number))
            sizes.append(len(buffer.message_from_id))
        assert page.frame == 5
        # Of each thing and property one message waits, however many frames were shown; six have been through all.
        assert max(sizes[12:]) <= 2 * max(sizes[:12])


def test_only_the_loop_of_the_server_talks_to_pages(server, layout, monkeypatch):
    threads = threads_that_push(monkeypatch)
    page = page_of(server, layout)
    for number in range(6):
        page.playback.seek(number)
        page.advance(float(number))
    assert page.frame == 5
    assert threads == {in_its_loop(server, threading.get_ident)}


def test_a_job_file_that_cannot_be_used_is_a_line_and_frames_stay(server, layout):
    page = page_of(server, layout)
    good = layout.job_file.read_text()
    layout.job_file.write_text("name = ")
    page.advance(10.0)
    assert "shown as it was before" in page.controls.notice.content
    assert page.frame == 0
    layout.job_file.write_text(good.replace("[[smoke]]", "[[light]]").partition("[[light]]")[0])
    page.advance(20.0)
    assert "shown as it was before" not in page.controls.notice.content
    assert "/smoke/plume" not in page.canvas.names
    assert "/fluid/water" in page.canvas.names


def test_a_take_that_is_being_recorded_has_all_frames_that_are_there(server, layout):
    layout.job_file.write_text(layout.job_file.read_text().replace("frames = 10", "frames = 1"))
    page = page_of(server, layout)
    assert ">6 of 6 frames simulated<" in page.controls.title.content
    assert page.controls.plot.scales["x"]["range"] == (0, 5)  # where the axis ends
    layout.job_file.write_text(layout.job_file.read_text().replace("frames = 1", "frames = 10"))
    page.advance(10.0)
    assert ">6 of 10 frames simulated<" in page.controls.title.content
    assert page.controls.plot.scales["x"]["range"] == (0, 9)


def test_a_folder_that_is_removed_leaves_a_page(server, layout):
    page = page_of(server, layout)
    shutil.rmtree(layout.root)
    page.advance(10.0)
    assert page.frames == ()
    assert "has no frame yet" in page.controls.notice.content


def test_a_frame_that_is_simulated_anew_is_read_anew(server, layout):
    page = page_of(server, layout)
    time.sleep(0.01)  # a receipt of the same size must have another time
    viewed_job.commit(layout, 0, fingerprint="other", energy=123.0)
    page.advance(10.0)
    assert page.frames == (0,)
    assert "123 J" in page.controls.table.content


def test_a_surface_of_the_frame_before_goes_when_the_frame_is_simulated_anew(server, layout):
    receipt = read_receipt(layout, layout.frame_cache(0))
    viewed_job.commit_surface(layout, receipt, 0)
    page = page_of(server, layout)
    page.controls._layers["Surfaces"].value = True
    page.advance(0.1)
    assert "/surface/water" in page.canvas.names
    time.sleep(0.01)
    viewed_job.commit(layout, 0, fingerprint="other", energy=123.0)
    page.advance(0.2)  # before it looks for new frames
    page.advance(10.0)
    assert page.frames == (0,)
    assert "/surface/water" not in page.canvas.names


def test_a_body_that_is_made_anew_is_drawn_anew(server, layout):
    page = page_of(server, layout)

    def radius() -> float:
        return float(server.scene.get_handle_by_name("/rigid/ball/body").vertices.max())

    assert radius() == pytest.approx(0.1, rel=0.01)
    text = layout.job_file.read_text()
    layout.job_file.write_text(
        text.replace(
            '"sphere", radius = 0.1 }\nposition = [0.7, 0.3', '"sphere", radius = 0.25 }\nposition = [0.7, 0.3'
        )
    )
    page.advance(10.0)
    assert radius() == pytest.approx(0.1, rel=0.01)  # as long as there is no other mesh
    time.sleep(0.01)
    for task in BodiesStage().plan(load_job(layout.job_file), layout):
        run_task(task, layout)
    page.advance(20.0)
    assert radius() == pytest.approx(0.25, rel=0.01)


def test_bodies_whose_stage_the_goal_of_the_job_leaves_out_are_drawn_as_the_scene_has_them(server, layout):
    job = load_job(layout.job_file)
    assert "bodies" not in {task.stage for task in plan_job(job, layout, STAGES, ("surface",))}
    mesh = layout.body_mesh("ball", "body")
    made = read_ply(layout.path(mesh))
    layout.receipt(mesh).unlink()
    layout.path(mesh).unlink()
    page = page_of(server, layout)
    drawn = server.scene.get_handle_by_name("/rigid/ball/body")
    assert np.array_equal(drawn.vertices, made.vertices)
    assert np.array_equal(drawn.faces, made.faces)
    assert "not shown" not in page.controls.notice.content
    layout.job_file.write_text(
        layout.job_file.read_text().replace(
            '"sphere", radius = 0.1 }\nposition = [0.7, 0.3', '"mesh", file = "gone.ply" }\nposition = [0.7, 0.3'
        )
    )
    page.advance(10.0)
    assert "ball is not shown: " in page.controls.notice.content


def test_pins_of_a_finer_cloth_than_the_frame_has_are_a_line(server, layout):
    text = layout.job_file.read_text()
    layout.job_file.write_text(text.replace("counts = [5, 5]", "counts = [9, 9]"))
    page = page_of(server, layout)
    assert page.frame == 0
    assert "pins of flag are not shown" in page.controls.notice.content
    assert "/cloth/flag" in page.canvas.names


def test_files_that_cannot_be_read_for_a_while_are_a_line(server, layout):
    page = page_of(server, layout)
    # A folder in the place of a receipt cannot be read, and a file in that of a folder not be looked into.
    viewed_job.commit(layout, 6)
    receipt = layout.receipt(layout.frame_cache(6))
    good = receipt.read_bytes()
    receipt.unlink()
    receipt.mkdir()
    page.advance(10.0)
    assert "cannot be read now" in page.controls.notice.content
    assert page.frame == 0
    receipt.rmdir()
    receipt.write_bytes(good)
    page.advance(20.0)
    assert "cannot be read now" not in page.controls.notice.content
    assert page.frames == tuple(range(7))
    meshes = layout.receipt(layout.body_mesh("ball", "body")).parent
    meshes.rename(meshes.with_name("elsewhere"))
    meshes.write_text("")
    page.advance(30.0)
    assert "cannot be read now" in page.controls.notice.content
    meshes.unlink()
    meshes.with_name("elsewhere").rename(meshes)
    page.advance(40.0)
    assert "cannot be read now" not in page.controls.notice.content


def test_a_slice_is_a_picture_whose_axes_are_those_of_the_cut_and_goes_when_it_is_not_drawn(server):
    smoke = Smoke("smoke", np.ones((2, 3, 4), np.float32), (0.0, 0.0, 0.0), 0.5)
    across = cut(smoke, axis="x", share=0.5, box=((0.0, 0.0, 0.0), (1.0, 1.5, 2.0)), densest=1.0)
    assert across is not None
    canvas = Canvas(server)
    with canvas.picture():
        canvas.slice("/smoke", across)
    handle = server.scene.get_handle_by_name("/smoke")
    w, x, y, z = handle.wxyz
    turn = Rotation.from_quat([x, y, z, w])
    # viser's pictures have x to the right and y down.
    assert turn.apply([1.0, 0.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])
    assert turn.apply([0.0, 1.0, 0.0]) == pytest.approx([0.0, 0.0, -1.0])
    assert handle.position == pytest.approx([0.5, 0.75, 1.0])
    assert (handle.render_width, handle.render_height) == (1.5, 2.0)
    with canvas.picture():
        canvas.points("/points", np.zeros((2, 3), np.float32), (255, 0, 0), radius=0.1)
    assert canvas.names == {"/points"}
    assert server.scene.get_handle_by_name("/smoke") is None


def test_particles_far_from_the_origin_are_sent_exactly_enough(server):
    canvas = Canvas(server)
    places = np.random.default_rng(1).uniform(0.0, 1.0, (100, 3)).astype(np.float32)
    for shift, radius in ((0.0, 0.01), (1000.0, 0.01), (0.0, 1e-4)):
        with canvas.picture():
            canvas.points("/points", places + np.float32(shift), (255, 0, 0), radius=radius)
        handle = server.scene.get_handle_by_name("/points")
        error = np.abs(handle.points.astype(np.float64) + handle.position - (places + np.float32(shift))).max()
        # A tenth of the radius, and what float32 itself is wrong by so far out.
        assert error <= 0.1 * radius + 2.0**-23 * (1.0 + shift)


def test_the_command_line_does_not_load_viser():
    code = "import sys, pipeline.cli.main; print('viser' in sys.modules)"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "False"
