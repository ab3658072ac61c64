"""The command puts a session and its page together."""

import math
import threading

import pytest
import viser
from live_jobs import BALL_OVER_SHEET, live, served
from page_threads import threads_that_push

from pipeline.web.live import running
from pipeline.web.live.soundness import LONGEST_FRAME_S
from pipeline.web.serving import in_its_loop

pytestmark = pytest.mark.usefixtures("taichi")


@pytest.mark.parametrize(("options", "longest_s"), [([], LONGEST_FRAME_S), (["--anyway"], math.inf)])
def test_a_frame_may_take_long_only_anyway_and_the_end_does_not_wait_for_it(tmp_path, monkeypatch, options, longest_s):
    found = []
    monkeypatch.setattr(
        running, "run", lambda session, _page, *, ends: found.append((session._timer.longest_s, session.ends is ends))
    )
    assert live(tmp_path, *options).exit_code == 0
    assert found == [(longest_s, True)]


@pytest.mark.parametrize("where", ["run", "Session", "Recorder"])
@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 9 GiB"), RuntimeError("CUDA: out of memory")])
def test_live_ends_with_a_line_where_no_memory_is_left(tmp_path, monkeypatch, where, error):
    def fails(*_arguments: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr(running, where, fails)
    ended = live(tmp_path)
    assert ended.exit_code == 1
    told = f"error: drape cannot go on, as no memory is left: {type(error).__name__}: {error}"
    assert told in ended.output.splitlines()


def test_the_address_is_there_and_the_page_says_what_it_waits_for_while_the_scene_is_built(tmp_path, monkeypatch):
    shown = []

    def builds(*_arguments: object, **_options: object) -> None:
        shown.extend(markdown.content for markdown in texts)
        raise MemoryError("as a test ends here")

    texts = []
    add = viser.GuiApi.add_markdown
    monkeypatch.setattr(
        viser.GuiApi, "add_markdown", lambda *given, **how: texts.append(add(*given, **how)) or texts[-1]
    )
    monkeypatch.setattr(running, "Session", builds)
    assert "runs drape; Ctrl-C ends it" in live(tmp_path).output
    assert shown == [running.BUILDING]


def test_errors_of_the_program_keep_their_traceback(tmp_path, monkeypatch):
    def fails(*_arguments: object, **_options: object) -> None:
        raise RuntimeError("Event loop is closed")

    monkeypatch.setattr(running, "run", fails)
    with pytest.raises(RuntimeError, match="Event loop is closed"):
        live(tmp_path)


def test_only_the_loop_of_the_server_talks_to_pages(tmp_path, monkeypatch):
    threads = threads_that_push(monkeypatch)
    with served(tmp_path, BALL_OVER_SHEET) as (session, page, server):
        threads.clear()  # the server began by itself
        for _ in range(3):
            session.advance()
            page.show()
            page.tell()
        assert threads == {in_its_loop(server, threading.get_ident)}
