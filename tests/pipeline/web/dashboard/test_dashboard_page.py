"""The dashboard in a real browser: buttons work, frames arrive without a reload, it fits a phone."""

import re

import av
import numpy as np
import pytest
from browser import PATIENCE_S, needs_browser, open_page
from browser import until as wait_for
from dashboards import dashboard, draw_frame, frame_job
from farm_processes import Farm, wait_until
from numbered_frames import commit, submitted
from playwright.sync_api import Page

from pipeline.base.task import FailureKind, TaskState
from pipeline.queue.job_queue import Desired, new_entry
from pipeline.record.manifest import Manifest
from pipeline.run.events import JobOutcome
from pipeline.show.report.film import as_address
from pipeline.show.report.page import write_report

pytestmark = needs_browser
PATIENCE_MS = 1000 * PATIENCE_S


def until(page: Page, condition: str) -> None:
    """Wait for a condition; Playwright's own way to wait needs `eval`, which our pages may not."""
    wait_for(lambda: page.evaluate(condition), condition, wait=lambda seconds: page.wait_for_timeout(1000 * seconds))


def test_a_queued_job_is_paused_and_cancelled_by_its_buttons(farm: Farm) -> None:
    farm.queue.enqueue(new_entry("dam", text=farm.job("dam").read_text()))
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/")
        page.evaluate("window.untouched = true")
        page.get_by_role("button", name="Pause").click()
        page.get_by_text("dam pauses").wait_for(timeout=PATIENCE_MS)
        assert farm.queue.find("dam").desired is Desired.PAUSE
        page.locator(".pill.is-paused").wait_for(timeout=PATIENCE_MS)
        page.get_by_role("button", name="Cancel").click()
        page.get_by_role("button", name="Keep it").click()
        assert farm.queue.find("dam") is not None
        page.get_by_role("button", name="Cancel").click()
        page.locator("#confirm .danger").click()
        page.get_by_text("dam is cancelled").wait_for(timeout=PATIENCE_MS)
        assert farm.queue.find("dam") is None
        assert page.evaluate("window.untouched")


def test_frames_appear_as_they_arrive_and_open_in_full(farm: Farm) -> None:
    layout = farm.layout("film")
    tasks = frame_job(layout, 4)
    faults: list[str] = []
    with dashboard(farm) as (client, _), open_page() as page, Manifest(layout.manifest) as manifest:
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"http://{client.place}/jobs/film")
        page.evaluate("window.untouched = true")
        assert page.locator(".grid img").count() == 0
        for count, task in enumerate(tasks[:2], start=1):
            draw_frame(layout, manifest, task)
            until(
                page,
                f"[...document.querySelectorAll('.grid img')].filter(i => i.naturalWidth === 320).length === {count}",
            )
        until(page, "document.querySelector('.part-head').innerText.includes('2 of 4')")
        page.locator(".grid a[data-frame='0']").click()
        until(page, "document.querySelector('#viewer img').naturalWidth === 640")
        page.keyboard.press("ArrowRight")
        page.locator("#viewer").get_by_text("frame 1", exact=True).wait_for(timeout=PATIENCE_MS)
        page.keyboard.press("Escape")
        assert not page.locator("#viewer").is_visible()
        assert page.evaluate("window.untouched")
    assert faults == []  # nor did the policy keep anything of ours from working


def test_the_film_in_a_report_is_let_through(farm: Farm) -> None:
    layout = farm.layout("film")
    frame_job(layout, 1)
    film = farm.folder / "film.mp4"
    with av.open(film, "w") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 90, np.uint8), format="rgb24")
        container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    address = as_address(film.read_bytes(), "video/mp4")
    layout.report.write_text(f'<!doctype html><title>film</title><video preload="auto" src="{address}"></video>')
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/jobs/film/report")
        until(page, "document.querySelector('video').readyState || document.querySelector('video').error")
        assert page.evaluate(
            "[document.querySelector('video').videoWidth, !document.querySelector('video').error]"
        ) == [64, True]


def test_what_a_failed_run_left_of_an_earlier_one_is_marked_and_times_have_dates(farm: Farm) -> None:
    layout = farm.layout("film")
    tasks = frame_job(layout, 3)
    with Manifest(layout.manifest) as manifest:
        for task in tasks:
            draw_frame(layout, manifest, task)
        manifest.begin_run("film", run="again")
        manifest.record_plan(tasks)
        manifest.set_states({task.id: TaskState.PENDING for task in tasks})
        draw_frame(layout, manifest, tasks[0])
        number = manifest.start_attempt(tasks[1].id)
        manifest.finish_attempt(tasks[1].id, number, failure=FailureKind.FAILED, message="no", state=TaskState.FAILED)
        manifest.end_run(JobOutcome.FAILED)
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/jobs/film")
        until(page, "document.querySelectorAll('.grid a').length === 3")
        labels = page.evaluate("[...document.querySelectorAll('.grid a')].map(each => each.innerText)")
        assert labels == ["0", "2 · old", "1 · old"]
        ended = [text for text in page.locator(".tasks td:nth-child(5)").all_inner_texts() if text != "–"]
        assert ended and all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", text) for text in ended)
        assert page.get_by_text("of an earlier run").count() == 0  # the newest frame is of this one
        with Manifest(layout.manifest) as manifest:
            manifest.set_states({tasks[0].id: TaskState.PENDING})
        page.goto(f"http://{client.place}/")
        page.get_by_text("of an earlier run").wait_for(timeout=PATIENCE_MS)


def test_a_report_draws_its_charts_and_runs_no_script_of_others(farm: Farm) -> None:
    layout = farm.layout("film")
    submitted(layout.root)
    for frame in range(3):
        commit(layout, frame, kinetic_energy=float(frame), potential_energy=2.0)
    write_report([layout], layout.report)
    text = layout.report.read_text()
    layout.report.write_text(text.replace("</body>", "<script>document.title = 'taken over'</script></body>"))
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/jobs/film/report")
        until(page, "document.querySelectorAll('figure canvas').length > 2")
        assert page.title() == "tank"


def test_tasks_are_found_and_their_logs_read_while_what_is_typed_stays(farm: Farm) -> None:
    farm.job("bad")
    farm.faults("bad", {"double/000002": ["fail"]})
    farm.here("submit", "bad.toml", code=5)
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/jobs/bad")
        page.get_by_placeholder("Find a task").fill("double/00000")
        until(page, "document.querySelectorAll('.tasks tbody tr').length === 6")
        page.get_by_label("State").select_option("failed")
        until(page, "document.querySelectorAll('.tasks tbody tr').length === 1")
        assert "state=failed" in page.url
        page.get_by_role("link", name="double/000002").click()
        page.locator(".log").wait_for(timeout=PATIENCE_MS)
        assert "a fault of the task's own" in page.locator(".log").inner_text()
        assert page.get_by_placeholder("Find a task").input_value() == "double/00000"
        page.go_back()
        until(page, "!document.querySelector('.log')")


def test_the_priority_that_is_shown_is_the_one_that_it_is(farm: Farm) -> None:
    farm.queue.enqueue(new_entry("dam", text=farm.job("dam").read_text()))
    with dashboard(farm) as (client, _), open_page() as page:
        page.goto(f"http://{client.place}/jobs/dam")
        field = page.get_by_label("Priority")
        page.evaluate("document.querySelector('input[type=number]').isOurs = true")
        for typed in ("7", "8"):
            field.fill(typed)
            page.get_by_role("button", name="Set").click()
            page.get_by_text(f"dam has priority {typed}").wait_for(timeout=PATIENCE_MS)
            until(page, f"document.querySelector('input[type=number]').getAttribute('value') === '{typed}'")
        farm.queue.change("dam", priority=3)  # by somebody else
        until(page, "document.querySelector('input[type=number]').value === '3'")
        field.fill("9")
        farm.queue.change("dam", priority=4)
        page.wait_for_timeout(1500)
        assert field.input_value() == "9"  # somebody types
        assert page.evaluate("document.querySelector('input[type=number]').isOurs")  # no change took it away


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(farm: Farm, scheme: str) -> None:
    layout = farm.layout("a-film-with-a-name-that-is-much-longer-than-any-telephone-is-wide-" + "x" * 60)
    tasks = frame_job(layout, 60, message="x" * 500)
    with Manifest(layout.manifest) as manifest:
        for task in tasks[1:8]:
            draw_frame(layout, manifest, task)
    farm.queue.put(new_entry(layout.root.name, desired=Desired.NONE, note="render/000000: " + "y" * 300))
    with dashboard(farm) as (client, _), open_page(390, 844, has_touch=True, color_scheme=scheme) as page:
        paths = ["/", f"/jobs/{layout.root.name}", f"/jobs/{layout.root.name}?task=render/000000"]
        for path in paths:
            page.goto(f"http://{client.place}{path}")
            page.wait_for_load_state("networkidle")
            assert page.evaluate("document.documentElement.scrollWidth") == 390, path
        assert page.evaluate("getComputedStyle(document.querySelector('.runner.off')).opacity") == "1"
        small = page.evaluate(
            "[...document.querySelectorAll('button')].filter(b => b.offsetParent && b.offsetHeight < 40).length"
        )
        assert small == 0, "a button is too low for a finger"


def test_a_dashboard_that_is_gone_is_told_and_one_that_is_back_goes_on(farm: Farm) -> None:
    frame_job(farm.layout("film"), 2)
    farm.queue.put(new_entry("film"))
    with dashboard(farm) as (client, process), open_page() as page:
        page.goto(f"http://{client.place}/")
        process.terminate()
        farm.finish(process)
        page.get_by_text("The dashboard does not answer").wait_for(timeout=PATIENCE_MS)
        port = client.place.partition(":")[2]
        again = farm.start("dashboard", "--port", port)
        until(page, "document.getElementById('trouble').hidden")
        page.get_by_role("button", name="Pause").click()  # of another session than when the page was loaded
        page.get_by_text("film pauses").wait_for(timeout=PATIENCE_MS)
        again.terminate()
        farm.finish(again)


def test_a_page_that_nobody_looks_at_asks_for_nothing(farm: Farm) -> None:
    frame_job(farm.layout("film"), 2)
    with dashboard(farm) as (client, _), open_page() as page:
        asked: list[str] = []
        page.goto(f"http://{client.place}/")
        page.on("request", lambda request: asked.append(request.url))
        wait = page.wait_for_timeout
        wait(3000)
        assert 1 <= len(asked) <= 4  # one after another, with a second between them
        page.evaluate(
            "Object.defineProperty(document, 'hidden', {get: () => true, configurable: true});"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
        wait(500)
        asked.clear()
        wait(3000)
        assert asked == []
        wait_until(lambda: client.ask("/parts").status == 200, "it does not answer")
