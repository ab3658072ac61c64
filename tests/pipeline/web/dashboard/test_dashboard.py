"""The dashboard over HTTP: what it shows, what it does, who may ask, and what goes wrong."""

import io
import os
import shutil
import signal
import socket
import sqlite3
import time
from pathlib import Path

import pytest
from dashboards import Client, dashboard, draw_frame, frame_job
from farm_processes import Farm, wait_until
from PIL import Image
from probes import probe

from pipeline.base.layout import JobLayout
from pipeline.base.lease import live_holder
from pipeline.base.task import TaskState
from pipeline.queue.job_queue import Desired, new_entry
from pipeline.record.manifest import Manifest
from pipeline.record.reader import ManifestReader
from pipeline.web.dashboard.farm_view import FarmView
from pipeline.web.dashboard.job_view import film_of
from pipeline.web.dashboard.places import Places

SCRIPT = "<script>alert(1)</script>"


def page_of(client: Client, name: str, query: str = "") -> str:
    answer = client.ask(f"/jobs/{name}{query}")
    assert answer.status == 200, answer.text
    return answer.text


def failed_job(farm: Farm, name: str) -> None:
    farm.job(name)
    farm.faults(name, {"double/000002": ["fail"]})
    farm.here("submit", f"{name}.toml", code=5)


def queued_job(farm: Farm, name: str, **fields: object) -> None:
    """A job that waits in the queue, that nobody runs."""
    farm.queue.enqueue(new_entry(name, text=farm.job(name).read_text(), **fields))


# --- what it shows ---
def test_every_job_is_shown_with_its_state_tasks_reasons_and_logs(farm: Farm) -> None:
    farm.job("good")
    farm.here("submit", "good.toml")
    failed_job(farm, "bad")
    queued_job(farm, "late")
    with dashboard(farm) as (client, _):
        listed = client.ask("/").text
        for name, state in (("good", "done"), ("bad", "failed"), ("late", "queued")):
            article = listed.partition(f'data-key="{name}"')[2].partition("</article>")[0]
            assert f'class="pill is-{state}"' in article, article
        assert "nobody runs the queue" in listed
        assert "7 of 8 tasks" not in listed  # of the bad one six steps and frames are done, and not its film
        bad = page_of(client, "bad", "?state=failed")
        assert "a fault of the task&#39;s own" in bad
        assert "what it needs has failed" in bad
        assert ">double/000002<" in bad
        assert ">double/000001<" not in bad.partition('id="tasks"')[2]
        story = page_of(client, "bad", "?task=double/000002")
        assert 'class="log"' in story
        assert "ValueError" in story.partition('class="log"')[2]


def test_jobs_are_found_by_a_part_of_their_name(farm: Farm) -> None:
    for name in ("drop-thin", "drop-thick", "dam"):
        queued_job(farm, name)
    with dashboard(farm) as (client, _):
        for question, found in (("DROP", {"drop-thin", "drop-thick"}), ("thick", {"drop-thick"}), ("", {"dam"})):
            listed = client.ask(f"/?find={question}").text
            assert all(f'data-key="{name}"' in listed for name in found)
        assert 'data-key="dam"' not in client.ask("/?find=drop").text
        nothing = client.ask("/?find=%3Cb%3Educk").text
        assert "&lt;b&gt;duck" in nothing
        assert "<b>duck" not in nothing
        assert client.ask("/parts?find=thick").text.count("data-key=") == 2  # the job, and its group


def test_tasks_come_by_the_page(farm: Farm) -> None:
    frame_job(farm.layout("long"), 10_000)
    with dashboard(farm) as (client, _):
        last = page_of(client, "long", "?page=200").partition('id="tasks"')[2]
        assert last.count("<tr") == 51
        assert ">render/009999<" in last
        assert ">render/009949<" not in last
        found = page_of(client, "long", "?text=0999&stage=render").partition('id="tasks"')[2]
        assert "11 tasks" in found  # 999, and 9990 to 9999
        assert "No task is so" in page_of(client, "long", "?stage=%27%20OR%201%3D1--")


def test_what_comes_from_jobs_is_text_and_never_markup(farm: Farm) -> None:
    name = "<script>alert(1)<x onclick=alert(2)>\"'&"
    frame_job(farm.layout(name.replace("/", "")), 3, message=f"{SCRIPT}\"'")
    spool_job = new_entry("noted", text="", desired=Desired.PAUSE, note=SCRIPT)
    farm.queue.put(spool_job)
    with dashboard(farm) as (client, _):
        listed = client.ask("/").text
        address = next(part for part in listed.split('"') if part.startswith("/jobs/%3Cscript"))
        page = client.ask(address).text
        story = client.ask(f"{address}?task=render/000000&text=%22%3E%3Cscript%3E").text
    for text in (listed, page, story):
        assert SCRIPT not in text
        assert "<x onclick" not in text
        assert '"><script>' not in text
    assert "&lt;script&gt;alert(1)" in listed
    assert "&lt;script&gt;alert(1)" in story


def test_only_the_parts_that_changed_are_sent(farm: Farm) -> None:
    tasks = frame_job(farm.layout("film"), 4)
    with dashboard(farm) as (client, _):
        parts = client.ask("/jobs/film/parts").json["parts"]
        known = ",".join(f"{name}={part['tag']}" for name, part in parts.items())
        wait_until(
            lambda: {*_changed(client, "/jobs/film/parts", known)} <= {"status"}, "parts change though nothing did"
        )
        with Manifest(farm.layout("film").manifest) as manifest:
            draw_frame(farm.layout("film"), manifest, tasks[2])
        wait_until(lambda: "frames" in _changed(client, "/jobs/film/parts", known), "a frame was not told of")
        changed = _changed(client, "/jobs/film/parts", known)
        assert "film" in changed
        assert "/jobs/film/frames/2/small" in changed["frames"]["html"]


def _changed(client: Client, path: str, known: str) -> dict[str, dict[str, str]]:
    answer = client.ask(path, Known_Parts=known)
    assert answer.status in (200, 204)
    return answer.json["parts"] if answer.status == 200 else {}


def test_frames_are_small_pictures_with_a_tag_and_only_committed_ones(farm: Farm) -> None:
    layout = farm.layout("film")
    tasks = frame_job(layout, 4)
    with Manifest(layout.manifest) as manifest:
        path = draw_frame(layout, manifest, tasks[1])
    shutil.copy(path, path.with_name("000003.png"))  # no receipt: it may be half a frame
    (path.parent / "000002.png").write_bytes(b"no picture")
    receipt = layout.receipt(tasks[1].outputs[0])
    shutil.copy(receipt, receipt.with_name("000002.png.json"))
    with dashboard(farm) as (client, _):
        small = client.ask("/jobs/film/frames/1/small")
        assert small.headers["content-type"] == "image/webp"
        assert Image.open(io.BytesIO(small.body)).size == (320, 180)
        assert len(small.body) < 10_000
        assert client.ask("/jobs/film/frames/1/small", If_None_Match=small.headers["etag"]).status == 304
        assert "immutable" in client.ask("/jobs/film/frames/1/small?7").headers["cache-control"]
        assert client.ask("/jobs/film/frames/2/small").status == 404
        assert client.ask("/jobs/film/frames/3/small").status == 404
        assert client.ask("/jobs/film/frames/1/huge").status == 404
        os.utime(path, ns=(1, 1))
        assert client.ask("/jobs/film/frames/1/small").headers["etag"] != small.headers["etag"]


def test_the_film_so_far_then_the_film_in_ranges(farm: Farm) -> None:
    layout = farm.layout("film")
    frame_job(layout, 2)
    with dashboard(farm) as (client, _):
        assert client.ask("/jobs/film/film").status == 404
        (layout.root / "movie-so-far.mp4").write_bytes(bytes(range(100)))
        assert "The film so far" in page_of(client, "film")
        part = client.ask("/jobs/film/film", Range="bytes=10-19")
        assert (part.status, part.body) == (206, bytes(range(10, 20)))
        assert part.headers["content-range"] == "bytes 10-19/100"
        assert client.ask("/jobs/film/film", Range="bytes=200-").status == 416
        (layout.root / "movie.mp4").write_bytes(b"finished")
        whole = client.ask("/jobs/film/film")
        assert (whole.status, whole.body, whole.headers["content-type"]) == (200, b"finished", "video/mp4")


def test_only_films_that_browsers_play_are_offered_to_be_played(farm: Farm) -> None:
    layout = farm.layout("film")
    frame_job(layout, 1)
    places = Places(farm.queue.farm)

    def is_playable(job_file: str) -> bool:
        layout.job_file.write_text(job_file)
        film = film_of(places, FarmView(places, farm.queue).job("film"))
        assert film is not None
        return film.is_playable

    (layout.root / "movie-so-far.mp4").write_bytes(b"so far")
    assert is_playable('movie.codec = "h265"')
    (layout.root / "movie-so-far.mp4").unlink()
    (layout.root / "movie.mp4").write_bytes(b"finished")
    assert not is_playable('name = "film"\n[movie]\ncodec = "h265"')
    for text in ("", '[movie]\ncodec = "av1"', "[movie]\ncrf = 12", "movie = 3", "no TOML", "a = " + "[" * 5000):
        assert is_playable(text), text[:40]
    (layout.root / "movie.mp4").rename(layout.root / "movie.mov")
    assert not is_playable('movie.codec = "prores"')


# --- what it does ---
def test_a_running_job_is_paused_resumed_and_cancelled(farm: Farm) -> None:
    farm.job("a", frames=60, pause_s=0.3)
    farm.run("submit", "a.toml", "--detach")
    wait_until(lambda: farm.frames_done("a") > 0, "it never began to work")
    with dashboard(farm) as (client, _):
        told = client.post("/jobs/a/pause").json["message"]
        assert told == "a pauses as soon as what runs is finished"
        wait_until(lambda: not farm.is_running("a") and live_holder(farm.queue.lease) is None, "it never stopped")
        assert farm.listed()["a"]["state"] == "paused"
        done = farm.frames_done("a")
        assert 0 < done < 60
        told = client.post("/jobs/a/resume").json["message"]
        assert "a runner was started, process" in told
        wait_until(lambda: farm.frames_done("a") > done, "it never went on")
        assert client.post("/jobs/a/resume").status == 409
        assert client.post("/jobs/a/priority", value="7").json["message"] == "a has priority 7"
        assert farm.queue.priority_of("a") == 7
        assert client.post("/jobs/a/priority", value="many").status == 409
        assert client.post("/jobs/a/cancel").status == 200
        wait_until(lambda: farm.settled("a"), "it was never cancelled")
        wait_until(lambda: 'class="pill is-stopped"' in page_of(client, "a"), "it is not shown as stopped")


def test_a_failed_job_is_tried_again_and_comes_to_its_end(farm: Farm) -> None:
    failed_job(farm, "a")
    with dashboard(farm) as (client, _):
        assert "Nobody runs the queue: a runner starts for it." in page_of(client, "a")
        assert client.post("/jobs/a/retry").status == 200
        wait_until(lambda: farm.settled("a"), "it never ended")
        wait_until(lambda: 'class="pill is-done"' in page_of(client, "a"), "it is not shown as done")
    assert (farm.layout("a").root / "film.bin").exists()


def test_jobs_that_wait_without_a_runner_get_one(farm: Farm) -> None:
    queued_job(farm, "a")
    with dashboard(farm) as (client, _):
        assert "a runner was started" in client.post("/work").json["message"]
        again = client.post("/work").json["message"]  # before the first one is there, or after
        assert "a runner is starting" in again or "the runner takes it" in again
        assert "nobody runs the queue" not in client.ask("/").text
        wait_until(lambda: farm.settled("a"), "it never ran")
        assert client.post("/jobs/a/pause").status == 409
        assert client.post("/jobs/nobody/pause").status == 404
        assert client.post("/jobs/a/explode").status == 409


def test_looking_leaves_no_trace_and_locks_nobody_out(farm: Farm) -> None:
    layout = farm.layout("film")
    tasks = frame_job(layout, 4)
    before = sorted(path.relative_to(layout.root) for path in layout.root.rglob("*"))
    with dashboard(farm) as (client, _):
        for _ in range(3):
            page_of(client, "film", "?task=render/000001")
        assert sorted(path.relative_to(layout.root) for path in layout.root.rglob("*")) == before
        assert not farm.queue.folder.exists()
        with Manifest(layout.manifest) as manifest:
            for task in tasks:
                number = manifest.start_attempt(task.id)
                page_of(client, "film")
                manifest.finish_attempt(task.id, number)
            manifest._connection.execute("PRAGMA journal_mode = DELETE")  # needs the file for itself


# --- who may ask ---
def test_requests_that_name_another_host_are_refused(farm: Farm) -> None:
    with dashboard(farm) as (client, _):
        port = client.place.partition(":")[2]
        strangers = (
            "evil.example",
            f"evil.example:{port}",
            f"127.0.0.1:{port}@evil.example",
            "user@127.0.0.1",
            "10.0.0.7",
            "127.0.0.1.evil.example",
            "",
            "localhost.evil",
        )
        for host in strangers:
            assert client.ask("/", Host=host).status in (400, 421), host
        for host in (f"localhost:{port}", f"127.0.0.1:{port}", f"[::1]:{port}"):
            assert client.ask("/", Host=host).status == 200, host


def test_a_request_with_two_lengths_is_refused(farm: Farm) -> None:
    with dashboard(farm) as (client, _):
        assert client.ask("/", Content_Length="5", Transfer_Encoding="chunked").status == 400
        assert client.ask("/").status == 200


def test_actions_need_their_own_page_and_a_post(farm: Farm) -> None:
    queued_job(farm, "a")
    with dashboard(farm) as (client, _):
        token = client.form_token()
        for headers in (
            {"Origin": None},
            {"Origin": "null"},
            {"Origin": "http://evil.example"},
            {"Origin": f"https://{client.place}"},
            {"Sec_Fetch_Site": "cross-site"},
            {"Sec_Fetch_Site": "same-site"},
            {"token": ""},
            {"token": "0" * 64},
            {"Cookie": None, "token": token},
            {"Cookie": f"{client.cookie}0", "token": token},
        ):
            assert client.post("/jobs/a/cancel", **headers).status == 403, headers
        other = Client(f"http://{client.place}")
        other.ask("/")
        assert other.post("/jobs/a/cancel", token=token).status == 403  # of another session
        for method in ("GET", "HEAD", "PUT", "DELETE"):
            assert client.ask("/jobs/a/cancel", method=method, body=f"form_token={token}").status in (404, 405), method
        assert client.ask("/work").status == 405
        assert farm.queue.find("a") is not None
        assert client.post("/jobs/a/cancel").status == 200
        assert farm.queue.find("a") is None


def test_answers_carry_a_policy_and_pages_name_no_other_place(farm: Farm) -> None:
    frame_job(farm.layout("a"), 2)
    (farm.layout("a").root / "report.html").write_text(SCRIPT)
    with dashboard(farm) as (client, _):
        first = Client(f"http://{client.place}").ask("/")
        assert "HttpOnly" in first.headers["set-cookie"]
        assert "SameSite=Strict" in first.headers["set-cookie"]
        for path in ("/", "/jobs/a", "/jobs/b", "/parts"):
            answer = client.ask(path)
            assert "default-src 'none'" in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert "://" not in answer.text
            assert " style=" not in answer.text
            assert "<script>" not in answer.text
        policy = client.ask("/jobs/a/report").headers["content-security-policy"].split("; ")
        assert {"default-src 'none'", "img-src data:", "media-src data:", "sandbox allow-scripts"} <= set(policy)
        for name in ("page.js", "morph.js", "viewer.js", "page.css"):
            assert "://" not in client.ask(f"/static/{name}").text


def test_a_scan_of_ports_costs_no_traceback_and_the_dashboard_goes_on(farm: Farm) -> None:
    with dashboard(farm) as (client, process):
        probe(int(client.place.partition(":")[2]))
        assert client.ask("/").status == 200
        process.terminate()
        said, complaints = process.communicate(timeout=60)
    assert "Traceback" not in said + (complaints or "")


def test_nothing_outside_of_the_farm_is_served(farm: Farm) -> None:
    layout = farm.layout("film")
    tasks = frame_job(layout, 4)
    secret = farm.folder / "secret.png"
    with Manifest(layout.manifest) as manifest:
        for task in tasks[:2]:
            draw_frame(layout, manifest, task)
        number = manifest.start_attempt(tasks[2].id)
        manifest.finish_attempt(tasks[2].id, number, message="see its log", state=TaskState.FAILED)
        manifest._connection.execute("UPDATE attempt SET log = '../../secret.png' WHERE task = ?", (tasks[2].id,))
    shutil.copy(layout.path(tasks[0].outputs[0]), secret)
    with secret.open("ab") as file:
        file.write(b"\nOUR SECRET\n")
    layout.path(tasks[0].outputs[0]).unlink()
    layout.path(tasks[0].outputs[0]).symlink_to(secret)
    (layout.root / "movie.mp4").symlink_to(secret)
    (layout.root / "report.html").symlink_to(secret)
    (farm.folder / "elsewhere").mkdir()
    shutil.copytree(layout.root, farm.folder / "elsewhere" / "film", symlinks=True)
    (farm.queue.farm / "linked").symlink_to(farm.folder / "elsewhere" / "film")
    (farm.queue.farm / "round").symlink_to("round")
    os.mkfifo(layout.root / "movie-so-far.mp4")
    with dashboard(farm) as (client, _):
        assert client.ask("/jobs/film/frames/1/small").status == 200
        for path in (
            *("/jobs/film/frames/0/small", "/jobs/film/film", "/jobs/film/report", "/jobs/linked/frames/1/small"),
            *(
                "/jobs/..%2fsecret.png",
                "/jobs/../secret.png",
                "/jobs/%2e%2e/secret.png",
                "/jobs/film/..%2f..%2fsecret.png",
            ),
            *("/static/", "/static", "/static/..%2fapp.py", "/static/../app.py", "/jobs/", "/jobs", "/jobs/film/"),
            *("/jobs/film/frames/", "/jobs/film/manifest.db", "/jobs/film/job.toml", "/jobs/.farm", "/jobs/a%00b"),
            *(
                "/jobs/film/frames/-1/small",
                "/jobs/film/frames/99999999999999999999/small",
                f"/jobs/film/frames/{'9' * 5000}/small",
                "/%2e%2e/%2e%2e/etc/passwd",
            ),
        ):
            answer = client.ask(path)
            assert answer.status in (404, 405), f"{path}: {answer.status}"
            assert b"OUR SECRET" not in answer.body
        story = page_of(client, "film", "?task=render/000002")
        assert "has left no log" in story
        assert "OUR SECRET" not in story
        assert "a link that leads out of the farm" in client.ask("/").text


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text("a-token-that-nobody-guesses\n")
    path.chmod(0o600)
    return path


def test_a_token_is_asked_for_once(farm: Farm, token_file: Path) -> None:
    frame_job(farm.layout("film"), 1)
    with dashboard(farm, "--token-file", str(token_file)) as (client, _):
        for path in ("/", "/jobs/film", "/parts", "/jobs/film/film", "/?token=wrong", "/?token="):
            answer = client.ask(path)
            assert answer.status == 401, path
            assert "film<" not in answer.text
            assert "set-cookie" not in answer.headers
        own = {"Origin": f"http://{client.place}"}
        assert client.ask("/enter", method="POST", body="token=wrong", **own).status == 401
        assert client.ask("/enter", method="POST", body="token=a-token-that-nobody-guesses").status == 403
        answer = client.ask("/?token=a-token-that-nobody-guesses")
        assert answer.status == 200
        assert "a-token-that-nobody-guesses" not in answer.text + client.cookie
        assert client.ask("/").status == 200
        other = Client(f"http://{client.place}")
        assert other.ask("/enter", method="POST", body="token=a-token-that-nobody-guesses", **own).status == 200
        assert other.ask("/").status == 200
        assert client.ask("/", Cookie=f"{client.cookie[:-1]}x").status == 401


def test_another_address_than_the_loopback_has_a_token_of_its_own(farm: Farm) -> None:
    farm.queue.farm.mkdir()
    process = farm.start("dashboard", "--port", "0", "--host", socket.gethostname())
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    process.send_signal(signal.SIGINT)
    farm.finish(process)
    assert len(address.partition("/?token=")[2]) == 43


# --- what goes wrong ---
def test_a_folder_that_is_not_there_is_told(farm: Farm) -> None:
    assert "there is no folder nowhere" in farm.here("dashboard", "--farm", "nowhere", code=1).err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_order_while_films_are_played(farm: Farm, number: signal.Signals) -> None:
    frame_job(farm.layout("film"), 1)
    (farm.layout("film").root / "movie.mp4").write_bytes(bytes(50_000_000))
    with dashboard(farm) as (client, process):
        with socket.create_connection(client.place.split(":")) as slow:  # asks, and does not read
            slow.sendall(f"GET /jobs/film/film HTTP/1.1\r\nHost: {client.place}\r\n\r\n".encode())
            began = time.monotonic()
            assert client.ask("/").status == 200
            process.send_signal(number)
            ended = farm.finish(process)
        assert time.monotonic() - began < 20.0
        assert "the page is closed; the jobs go on" in ended.err
        assert "Traceback" not in ended.err


def test_records_that_cannot_be_read_are_told_and_the_page_lives(farm: Farm) -> None:
    names = ("good", "damaged", "newer", "unfinished", "strange", "emptied", "piped", "foldered")
    for name in names:
        frame_job(farm.layout(name), 2)
    os.mkfifo(farm.layout("piped").lease)
    farm.layout("piped").manifest.unlink()
    os.mkfifo(farm.layout("piped").manifest)
    farm.layout("foldered").lease.mkdir()
    farm.layout("foldered").receipt(JobLayout.picture(0)).mkdir(parents=True)
    farm.layout("damaged").manifest.write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 64)
    for name, change in (("newer", "PRAGMA user_version = 99"), ("strange", "UPDATE task SET state = 'dreaming'")):
        with sqlite3.connect(farm.layout(name).manifest) as connection:
            connection.execute(change)
        connection.close()
    farm.layout("unfinished").manifest.write_bytes(b"")
    farm.layout("emptied").manifest.unlink()
    (farm.queue.folder / "queue").mkdir(parents=True)
    (farm.queue.folder / "queue" / "odd.json").write_text("{")
    with dashboard(farm) as (client, _):
        listed = client.ask("/").text
        flaws = "is damaged", "use the newer program", "not finished when it was made", "dreaming", "odd.json"
        assert [flaw for flaw in flaws if flaw not in listed] == []
        for name in names:
            page_of(client, name)
            assert client.ask(f"/jobs/{name}/frames/0/small").status == 404
            page_of(client, name, "?task=render/000000&page=3")


def test_names_that_are_not_utf_8_are_shown_and_take_no_page_down(farm: Farm) -> None:
    folder = os.fsdecode(b"r\xe9nders")
    frame_job(farm.layout("good"), 1)
    queued_job(farm, "waiting")  # has forms
    shutil.copytree(farm.layout("good").root, farm.queue.farm / os.fsdecode(b"caf\xe9"))
    (farm.queue.folder / "queue" / "odd.json").write_text("{")
    farm.queue.farm.rename(farm.folder / folder)
    with dashboard(farm, folder=folder) as (client, _):
        listed = client.ask("/").text
        assert ">good</a>" in listed
        assert "caf\\udce9" in listed
        assert "not UTF-8" in listed
        assert "r\\udce9nders/.farm/queue/odd.json" in listed
        assert '"pill is-unknown"' in listed
        assert "0 of 1 tasks" in page_of(client, "good")
        assert "not UTF-8" in page_of(client, "caf%5Cudce9")
        assert client.ask("/jobs/caf%E9").status == 404
        assert client.post("/jobs/odd/cancel").status == 404


def test_a_form_that_is_cut_off_asks_for_nothing_and_is_no_fault(farm: Farm) -> None:
    queued_job(farm, "a")
    with dashboard(farm) as (client, process):
        token = client.form_token()
        head = f"Host: {client.place}", f"Origin: http://{client.place}", f"Cookie: {client.cookie}"
        lines = "\r\n".join((*head, "Content-Length: 100", ""))
        with socket.create_connection(client.place.split(":")) as cut:
            cut.sendall(f"POST /jobs/a/cancel HTTP/1.1\r\n{lines}\r\nform_token={token}&value=".encode())
            time.sleep(0.2)  # so that it is waited for when it is cut off; without it, it is seen as cut off at once
        assert client.ask("/").status == 200
        assert farm.queue.find("a") is not None
        process.terminate()
        assert "Traceback" not in farm.finish(process).err


def test_a_job_that_goes_while_it_is_looked_at_is_told(farm: Farm) -> None:
    frame_job(farm.layout("film"), 2)
    with dashboard(farm) as (client, _):
        page_of(client, "film")
        shutil.rmtree(farm.layout("film").root)
        wait_until(lambda: client.ask("/jobs/film/parts").status == 404, "it is still shown")
        told = client.ask("/jobs/film/parts", Accept="application/json").json["message"]
        assert told == 'there is no job "film" in this farm'
        assert "Nothing here yet" in client.ask("/").text


def test_a_killed_runner_leaves_a_job_that_can_be_resumed(farm: Farm) -> None:
    process = farm.start("submit", farm.job("a", frames=60, pause_s=0.3).name)
    wait_until(lambda: farm.frames_done("a") > 0, "it never began to work")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    with dashboard(farm) as (client, _):
        page = page_of(client, "a")
        assert 'class="pill is-queued"' in page
        assert 'class="pill is-running"' not in page
        farm.faults("a", {})
        assert client.post("/work").status == 200
        wait_until(lambda: farm.settled("a"), "it was never finished")
    with ManifestReader.open_readonly(farm.layout("a").manifest) as manifest:
        assert manifest.last_run().outcome == "succeeded"
